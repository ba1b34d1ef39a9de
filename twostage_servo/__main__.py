# PYTHON_ARGCOMPLETE_OK
"""``python -m twostage_servo``, and the console script: nothing is imported before Ctrl-C is provided for."""

import sys


def entry_point() -> None:
    """Run the command line; Ctrl-C ends it quietly with 130, also while it is being imported."""
    try:
        from twostage_servo.cli.main import main  # noqa: PLC0415 - which takes a second

        code = main()
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


if __name__ == "__main__":
    entry_point()
