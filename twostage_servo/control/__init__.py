"""The mathematics: plant, gains, observer and law.

No clock, no input or output, no logging: numbers in, numbers out. Equation numbers are those of H. Ogawa et al., "Two
Stage Control Method Using a Disturbance Observer and a Kalman Filter"; "erratum n" is entry n of the list of that
paper's corrected slips in ``docs/law.md``.
"""
