"""Frames: the codec compiled from a DBC, the drive profile, one opened bus, and a bus between processes."""
