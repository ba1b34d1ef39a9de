"""The rooms of the package as its imports make them: circles, and a picture; ``python -m tools.rooms.draw --help``."""
