"""What the product's law is compared with. For study: none of these knows a stop or a lost sample.

Those of the paper, without any limit:

- :mod:`~twostage_servo.control.baselines.pid`: the controller of the paper's introduction.
- :mod:`~twostage_servo.control.baselines.optimal_servo`: section II, one stage.
- :mod:`~twostage_servo.control.baselines.conventional`: section III, two stages with a plant model, and the same with
  the feedback of reference [6].
- :mod:`~twostage_servo.control.baselines.transcription`: section IV in the paper's own matrices, with a switch for
  each way to read the print.

Those of the field, within the limits of effort and effort rate, with parameters that an optimiser may choose
(:mod:`~twostage_servo.control.baselines.tunable`):

- :mod:`~twostage_servo.control.baselines.trapezoid` and :mod:`~twostage_servo.control.baselines.jerk_limited`: a
  profile, feed-forward, state feedback, disturbance observer.
- :mod:`~twostage_servo.control.baselines.proximate_time_optimal`: PTOS.
- :mod:`~twostage_servo.control.baselines.composite_nonlinear`: a speed stage, then composite nonlinear feedback.
- :mod:`~twostage_servo.control.baselines.initial_value`: two stages with initial value compensation.
- :mod:`~twostage_servo.control.baselines.optimal_two_stage`: the paper's law with other weights and variances.
- :mod:`~twostage_servo.control.baselines.active_disturbance_rejection`: ADRC on a profile.
- :mod:`~twostage_servo.control.baselines.profile_pid`: PID on a profile.
"""
