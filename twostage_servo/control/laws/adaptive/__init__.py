"""The adaptive two-stage law: it identifies its plant while it accelerates, and brakes onto the set-point."""
