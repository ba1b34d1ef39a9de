"""The tables ``[axis]`` and below: what the axis is, how its law is designed, and what it must never exceed."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from twostage_servo.axis.law_settings import LawSettings, choose_law
from twostage_servo.exact import exact
from twostage_servo.settings.base import Settings, quantity

_BACK_OFF_WINDOWS = 20.0
"""Position windows by which a hard stop is left, where the settings do not say."""


class PlantSettings(Settings):
    """The model of the plant, drive included: G(s) = gain / (s (s + pole)), effort to position."""

    gain: float = quantity(
        unit="axis unit/s²/effort unit",
        description="Acceleration per effort at standstill; negative if the drive is mounted in reverse",
        ge=-1e9,
        le=1e9,
    )
    pole: float = quantity(unit="1/s", description="Reciprocal of the velocity's time constant", ge=1e-3, le=1e4)

    @model_validator(mode="after")
    def _drivable(self) -> Self:
        if abs(self.gain) < 1e-9:
            raise ValueError(f"gain = {exact(self.gain)}: effort would not move this plant; give its gain, such as 180")
        return self


class ObserverSettings(Settings):
    """What the Kalman disturbance observer assumes of disturbance and noise."""

    position_variance: float = quantity(
        0.1, unit="(axis unit)²", description="Process variance of the position per tick", ge=0.0, le=1e9
    )
    velocity_variance: float = quantity(
        0.1, unit="(axis unit/s)²", description="Process variance of the velocity per tick", ge=0.0, le=1e9
    )
    disturbance_variance: float = quantity(
        0.1, unit="(effort unit)²", description="Process variance of the disturbance per tick", ge=1e-12, le=1e9
    )
    measurement_variance: float = quantity(
        0.01, unit="(axis unit)²", description="Variance of the measured position (R_o)", ge=1e-12, le=1e9
    )
    disturbance_memory: float = quantity(
        1.0, unit="1", description="1: the disturbance persists; 0: as printed in the paper (erratum 5)", ge=0.0, le=1.0
    )


class LimitSettings(Settings):
    """What the axis must never exceed. All are mandatory, except `undetected_travel`: see its description."""

    renamed: ClassVar = {
        "innovation": "innovation_gate",
        "jam_effort": "stall_effort",
        "jam_time_ms": "stall_time_ms",
    }

    position_minimum: float = quantity(unit="axis unit", description="Lowest set-point accepted", ge=-1e9, le=1e9)
    position_maximum: float = quantity(unit="axis unit", description="Highest set-point accepted", ge=-1e9, le=1e9)
    position_overrun: float = quantity(
        unit="axis unit",
        description="Distance beyond the position limits within which the axis must come to rest, or it trips",
        gt=0.0,
        le=1e9,
    )
    undetected_travel: float | None = quantity(
        None,
        unit="axis unit",
        description="Distance that the axis may move until a reversed or rescaled encoder is detected; if absent, "
        "position_overrun",
        gt=0.0,
        le=1e9,
    )
    velocity: float = quantity(unit="axis unit/s", description="Largest cruise velocity accepted", gt=0.0, le=1e9)
    overspeed: float = quantity(
        unit="axis unit/s",
        description="Estimated speed at which the axis trips; above the velocity limit",
        gt=0.0,
        le=1e9,
    )
    acceleration: float = quantity(
        unit="axis unit/s²", description="Largest slope of the speed reference, up and down", gt=0.0, le=1e12
    )
    quick_stop_deceleration: float = quantity(
        unit="axis unit/s²", description="Slope of the speed reference in a quick stop", gt=0.0, le=1e12
    )
    effort: float = quantity(unit="effort unit", description="Largest magnitude of the effort", gt=0.0, le=1e9)
    effort_rate: float = quantity(
        unit="effort unit/s", description="Largest slope of the effort, except when disabling", gt=0.0, le=1e12
    )
    effort_saturation_ms: float = quantity(
        unit="ms", description="Time at the effort limit after which the axis trips", gt=0.0, le=60_000.0
    )
    following_error_minimum: float = quantity(
        unit="axis unit", description="Following error at which the axis trips, at standstill", gt=0.0, le=1e9
    )
    following_error_time_s: float = quantity(
        unit="s",
        description="Following error allowed per axis unit/s of the move's speed, if that is more",
        ge=0.0,
        le=60.0,
    )
    innovation_gate: float = quantity(
        unit="axis unit",
        description="Innovation gate at standstill: distance of a sample from its prediction beyond which it is "
        "rejected; a second consecutive one trips",
        gt=0.0,
        le=1e9,
    )
    innovation_time_ms: float = quantity(
        unit="ms",
        description="Width added to the innovation gate per axis unit/s of speed: error of the sampling instant",
        ge=0.0,
        le=100.0,
    )
    stall_effort: float = quantity(
        unit="effort unit",
        description="Effort, or change of effort, at which an axis without motion has stalled; must exceed friction",
        gt=0.0,
        le=1e9,
    )
    stall_time_ms: float = quantity(
        unit="ms", description="Time at stall_effort without motion after which the axis trips", gt=0.0, le=60_000.0
    )
    stale_feedback_ms: float = quantity(
        unit="ms", description="Time without fresh feedback after which an armed axis trips", gt=0.0, le=10_000.0
    )
    feedback_errors: int = quantity(
        unit="frames",
        description="Number of frames lost, corrupted, repeated, out of order or implausible in the last 100 ticks at "
        "which an armed axis trips",
        ge=1,
        le=100,
    )
    heartbeat_ms: float = quantity(
        unit="ms",
        description="Time without the drive's heartbeat after which an armed axis trips, if the drive has one",
        gt=0.0,
        le=60_000.0,
    )
    missed_ticks: int = quantity(
        unit="ticks", description="Ticks missed in a row after which an armed axis trips", ge=0, le=1000
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.position_minimum >= self.position_maximum:
            raise ValueError(
                f"position_minimum = {exact(self.position_minimum)} is not below position_maximum = "
                f"{exact(self.position_maximum)}; swap or correct them"
            )
        if self.quick_stop_deceleration < self.acceleration:
            raise ValueError(
                f"quick_stop_deceleration = {exact(self.quick_stop_deceleration)} is below acceleration = "
                f"{exact(self.acceleration)}: a quick stop must not be gentler than an ordinary one"
            )
        if self.overspeed <= self.velocity:
            raise ValueError(
                f"overspeed = {exact(self.overspeed)} is not above velocity = {exact(self.velocity)}, so an ordinary "
                f"cruise would trip; about {1.25 * self.velocity:g} is usual"
            )
        if self.stall_effort > self.effort:
            raise ValueError(
                f"stall_effort = {exact(self.stall_effort)} is above effort = {exact(self.effort)}, so a stall could "
                "never trip; lower it"
            )
        return self


class WindowSettings(Settings):
    """When a move counts as done (CiA 402: position window and position window time)."""

    position: float = quantity(
        unit="axis unit", description="Largest error of a position that counts as reached", gt=0.0, le=1e9
    )
    time_ms: float = quantity(
        unit="ms", description="Time for which the position must stay in the window", ge=0.0, le=60_000.0
    )


class HomingSettings(Settings):
    """How the axis finds the place from which positions are counted."""

    required: bool = Field(
        default=False, description="Whether set-points are refused until the axis is homed (an incremental encoder)"
    )
    method: Literal["set_here", "switch", "hard_stop", "index"] = Field(
        "set_here",
        description="Reference: where the axis stands, a home switch, a rigid stop, or the encoder's index mark",
    )
    position: float = quantity(0.0, unit="axis unit", description="Position of the reference", ge=-1e9, le=1e9)
    direction: Literal["positive", "negative"] = Field(
        "negative", description="Direction of the search for the reference"
    )
    velocity: float = quantity(
        20.0, unit="axis unit/s", description="Speed of the search, and of a jog before homing", gt=0, le=1e9
    )
    slow_velocity: float = quantity(
        5.0, unit="axis unit/s", description="Speed of the last approach to the reference", gt=0.0, le=1e9
    )
    effort: float = quantity(
        5.0, unit="effort unit", description="Largest effort in the search for a hard stop", gt=0.0, le=1e9
    )
    stop_time_ms: float = quantity(
        200.0, unit="ms", description="Standstill with that effort that counts as the hard stop", gt=0.0, le=60_000.0
    )
    back_off: float = quantity(
        0.0,
        unit="axis unit",
        description="Distance that the axis then backs off; must exceed what the stop yields. 0: 20 position windows",
        ge=0.0,
        le=1e9,
    )
    travel: float = quantity(
        1000.0, unit="axis unit", description="Distance after which the search fails", gt=0.0, le=1e9
    )


class ApproachSettings(Settings):
    """From which side a move ends, so that backlash does not show."""

    direction: Literal["either", "positive", "negative"] = Field(
        "either", description="Direction of the last part of every move"
    )
    distance: float = quantity(
        1.0,
        unit="axis unit",
        description="Distance by which a move from the other side first overshoots its set-point",
        gt=0,
        le=1e9,
    )


class AxisSettings(Settings):
    """One drive with its law and limits."""

    name: str = Field(
        "axis", description="Name in logs and status", min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f]*$"
    )
    unit: str = Field(description="Unit of position, such as mm or deg", min_length=1, max_length=16)
    effort_unit: str = Field(description="Unit of the effort, such as V, A or %", min_length=1, max_length=16)
    cruise_velocity: float = quantity(
        unit="axis unit/s", description="Velocity of a set-point that does not give one", gt=0.0, le=1e9
    )
    arming_timeout_ms: float = quantity(
        500.0, unit="ms", description="Time that the drive may take to report that it is enabled", gt=0.0, le=60_000.0
    )
    jog_timeout_ms: float = quantity(
        300.0,
        unit="ms",
        description="Time after which a jog ends unless it is renewed",
        gt=0.0,
        le=2_000.0,
    )
    plant: PlantSettings
    law: Annotated[LawSettings, BeforeValidator(choose_law)] = LawSettings()
    observer: ObserverSettings = ObserverSettings()
    limits: LimitSettings
    window: WindowSettings
    homing: HomingSettings = HomingSettings()
    approach: ApproachSettings = ApproachSettings()

    @model_validator(mode="after")
    def _cruise_within_limits(self) -> Self:
        if self.cruise_velocity > self.limits.velocity:
            raise ValueError(
                f"cruise_velocity = {exact(self.cruise_velocity)} is above limits.velocity = "
                f"{exact(self.limits.velocity)}: lower it"
            )
        for name in ("velocity", "slow_velocity"):
            if getattr(self.homing, name) > self.limits.velocity:
                raise ValueError(
                    f"homing.{name} = {exact(getattr(self.homing, name))} is above limits.velocity = "
                    f"{exact(self.limits.velocity)}: lower it"
                )
        if self.homing.effort > self.limits.effort:
            raise ValueError(
                f"homing.effort = {exact(self.homing.effort)} is above limits.effort = {exact(self.limits.effort)}: "
                "lower it"
            )
        return self

    @model_validator(mode="after")
    def _homed_within_limits(self) -> Self:
        homing, limits = self.homing, self.limits
        if homing.method == "set_here" and "position" not in homing.model_fields_set:
            return self  # the operator then has to tell a place: `home --here POSITION`
        place, what = homing.position, "where the axis is when it has been homed"
        if homing.method == "hard_stop":
            place += self.back_off if homing.direction == "negative" else -self.back_off
            what = f"so that the axis is at {place:g} when it has left the hard stop"
        lowest = limits.position_minimum - limits.position_overrun
        highest = limits.position_maximum + limits.position_overrun
        if not lowest <= place <= highest:
            raise ValueError(
                f"homing.position = {homing.position:g}, {what}: that is outside limits.position_minimum = "
                f"{limits.position_minimum:g} to position_maximum = {limits.position_maximum:g} with "
                f"position_overrun = {limits.position_overrun:g}, where the axis trips; correct one of them"
            )
        return self

    @property
    def back_off(self) -> float:
        """How far the axis leaves a hard stop that it has found, in axis unit."""
        return self.homing.back_off or _BACK_OFF_WINDOWS * self.window.position
