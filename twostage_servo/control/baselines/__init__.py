"""What the product's law is compared with. For study: none of these knows a limit, a stop or a lost sample.

- :mod:`~twostage_servo.control.baselines.pid`: the controller of the paper's introduction.
- :mod:`~twostage_servo.control.baselines.optimal_servo`: section II, one stage.
- :mod:`~twostage_servo.control.baselines.conventional`: section III, two stages with a plant model, and the same with
  the feedback of reference [6].
- :mod:`~twostage_servo.control.baselines.transcription`: section IV in the paper's own matrices, with a switch for
  each way to read the print.
"""
