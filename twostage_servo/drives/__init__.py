"""Drives: what a drive is to an axis, and each kind of drive. Pure: bytes in, reports out, and the way back."""
