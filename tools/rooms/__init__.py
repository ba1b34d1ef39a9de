"""The rooms of the package as its imports make them: circles, and a picture; ``python -m tools.rooms.draw --help``.

And what one part may do to another: ``python -m tools.rooms.assignments``.
"""
