"""What crosses the control socket: requests, typed status, and where the socket is. The standard library only."""
