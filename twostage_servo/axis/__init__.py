"""One axis: its law, limits, state machine and trips. Pure: feedback and requests in, commands out."""
