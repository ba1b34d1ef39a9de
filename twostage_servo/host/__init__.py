"""The host: what the machine is asked for so that ticks are punctual, and what can be said about it."""
