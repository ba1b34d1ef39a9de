"""The running service: the tick, the loop around the axis and its bus, and the control socket."""
