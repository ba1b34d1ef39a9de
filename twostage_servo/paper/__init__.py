"""The paper's examples, run again: every method on both plants, scored, drawn and written up.

Numbers in, numbers out, but for :mod:`~twostage_servo.paper.plots` and :mod:`~twostage_servo.paper.report`. Time is
counted in sampling periods; nothing here knows a bus. Units are the paper's: mm, mm/s, and V for the effort.
"""
