"""The transport: one opened bus, its counters and errors, the age of a frame, and a bus between processes."""
