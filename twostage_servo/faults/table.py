"""The faults that the axis must meet, as data: what is injected, in which phases, what is expected, and its budget."""

import math
import signal
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

from twostage_servo.axis.trips import Reaction
from twostage_servo.config.loader import Config
from twostage_servo.control.model_monitor.hypotheses import ACCEPTED, OTHER_GAINS
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.faults import bus_faults, client_faults, drive_faults, host_faults, resource_faults
from twostage_servo.faults.budget import Budget
from twostage_servo.faults.checks import (
    Check,
    arrived,
    bus_error_reported,
    came_back_disarmed,
    continuous,
    ended_with_an_error,
    log_dropped,
    needs_homing,
    only_off_the_switch,
    refused_all,
    rejected_some,
    right_or_not_trusted,
    still_enabled_is_told,
    still_seen,
    told_how_far,
    told_in_time,
    trips_early,
    within_stall_effort,
)
from twostage_servo.faults.frames import protocol_of
from twostage_servo.faults.limits import Limit, either, hidden_by_noise, looks_like_the_model, too_slow
from twostage_servo.faults.phase import ALL, ARMED, BRAKED, EVERYWHERE, MOVING, SEARCHING, Phase
from twostage_servo.faults.world import World

PROCESS_FAULTS = (37, 38, 39, 42, 54)
"""Faults that need real processes, in real time."""

TOLERATED, HELD, STOPPED, QUICK, DISABLED, REFUSED = "T", "H", "S", "Q", "Z", "R"
LETTERS = {
    Reaction.NONE: TOLERATED,
    Reaction.HOLD: HELD,
    Reaction.CONTROLLED_STOP: STOPPED,
    Reaction.QUICK_STOP: QUICK,
    Reaction.DISABLE: DISABLED,
}
MEANINGS = {
    TOLERATED: "tolerated: the move continues; what is missing is bridged and counted",
    HELD: "controlled stop, then the axis holds",
    STOPPED: "controlled stop, then disabled; latched",
    QUICK: "quick stop, then disabled; latched",
    DISABLED: "effort zero and drive disabled at once; latched",
    REFUSED: "the request is refused",
}

Inject = Callable[[World, Random], None]
Bound = Callable[[Budget], float]
Expected = str | dict[Phase, str] | Callable[[Config, Phase], str]


@dataclass(frozen=True)
class Fault:
    """One fault, or one size of it.

    Attributes
    ----------
    number
        Its number in the list of faults.
    name
        What happens, in a few words.
    inject
        Makes it happen, with a random number generator for what is not given.
    expected
        The reaction, one of :data:`MEANINGS`; for some phases another one, or what follows from the configuration.
    bound
        The largest travel that it may cost, in axis unit.
    phases
        Where it can happen.
    idle
        What is expected while the axis is disarmed: by default that arming is refused if the fault disables an armed
        axis, and that nothing else happens if it does not.
    check
        What else has to be true at the end.
    prepare
        What has to be arranged before the axis is armed.
    again
        Whether a second move follows: a fault that does not show while the axis comes to rest shows in the next one.
    idle_bound
        The travel that it may cost if it begins while the axis is disarmed, if that is another one.
    refused_bound
        The travel that it may cost where a move is refused, if it shows at all.
    needs
        Whether the axis' drive and settings have what the fault is about.
    reason
        What is missing where it has not.
    why_not
        Why an axis with such a configuration cannot have it; empty if it can.
    velocity_limit
        Whether the move runs at the velocity limit.
    shows_s
        How long after the axis has come to rest it may take to show, in s, on the axis of a configuration.
    instead
        A more severe reaction that may take the place of the expected one: where it travels less, or where the fault
        keeps the expected one from working.
    limit
        What one encoder cannot tell in a motion, so that the fault may be tolerated there; empty where it can.
    limit_bound
        The travel that it may cost then, in axis unit.
    shared
        Whether it is a fault of what all axes of a machine share, so that another axis may trip by it as well.
    note
        What the reader of the matrix should know.
    """

    number: int
    name: str
    inject: Inject
    expected: Expected
    bound: Bound
    phases: tuple[Phase, ...] = ALL
    idle: str | None = None
    check: Check | None = None
    prepare: Callable[[World], None] | None = None
    again: bool = False
    idle_bound: Bound | None = None
    refused_bound: Bound | None = None
    needs: Callable[[DriveProfile, ProtocolSettings], bool] = lambda *_: True
    reason: str = "the drive of this configuration has no such signal"
    why_not: Callable[[Config], str] = lambda _: ""
    velocity_limit: bool = False
    shows_s: Callable[[Config], float] = lambda _: 0.0
    instead: str = ""
    limit: Limit = lambda _: ""
    limit_bound: Bound | None = None
    shared: bool = False
    note: str = ""

    def budget(self, phase: Phase, expected: str) -> Bound:
        """Return what gives the bound in a phase in which a reaction is expected."""
        if phase is Phase.IDLE and self.idle_bound is not None:
            return self.idle_bound
        refused_to_move = expected == REFUSED and self.expected != REFUSED
        return (self.refused_bound or _unnoticed) if refused_to_move else self.bound

    def expectation(self, phase: Phase, config: Config) -> str:
        """Return the letter of the reaction that is expected in a phase, on the axis of a configuration."""
        if callable(self.expected):
            return self.expected(config, phase)
        if phase is Phase.IDLE:
            if self.idle is not None:
                return self.idle
            if self.expected in {TOLERATED, REFUSED}:
                return str(self.expected)
            return REFUSED
        return self.expected if isinstance(self.expected, str) else self.expected.get(phase, TOLERATED)


def _bridged(budget: Budget) -> float:
    return budget.bridged()


def _unnoticed(budget: Budget) -> float:
    return budget.unnoticed()


def _followed(budget: Budget) -> float:
    return budget.followed()


def _stale(budget: Budget) -> float:
    return budget.stale()


def _at_once(budget: Budget) -> float:
    return budget.coasting(budget.detection_s(0))


def _errors(budget: Budget) -> float:
    return budget.quick_stop(budget.detection_s(budget.limits.feedback_errors))


def _heartbeat(budget: Budget) -> float:
    return budget.coasting(budget.limits.heartbeat_ms / 1e3 + budget.detection_s(0))


def _command_timeout(budget: Budget) -> float:
    return budget.coasting(budget.command_timeout_s + budget.detection_s(1))


def _retargeted(budget: Budget) -> float:
    return budget.followed() + host_faults.LARGEST_RETARGET * budget.reference.length()


def _disarmed_and_moved(budget: Budget) -> float:
    return budget.disarmed() + budget.moved_while_disabled(_D.CREEP_GATES)


def _contradicts(profile: DriveProfile, _: ProtocolSettings) -> bool:
    return profile.heartbeat_id is not None and _D.FAULT_STATE in {
        text.lower() for text in profile.traits.state_texts.values()
    }


def _suspended_travel(duration_s: float) -> Bound:
    def bound(budget: Budget) -> float:
        match host_faults.after_suspension(
            duration_s, budget.tick_s, budget.limits.missed_ticks, budget.command_timeout_s
        ):
            case Reaction.DISABLE:
                return _command_timeout(budget)
            case Reaction.QUICK_STOP:
                return budget.quick_stop(duration_s + budget.detection_s(0))
        return budget.followed()

    return bound


def _suspended(duration_s: float) -> Expected:
    """Expect what missed ticks and the drive's own time-out make of a suspended host; disarmed, nothing is missed."""

    def expected(config: Config, phase: Phase) -> str:
        reaction = host_faults.after_suspension(
            duration_s,
            config.service.tick_ms / 1e3,
            config.axis.limits.missed_ticks,
            config.simulation.command_timeout_ms / 1e3,
        )
        return TOLERATED if phase is Phase.IDLE else LETTERS[reaction]

    return expected


def _unheard(config: Config, phase: Phase) -> str:
    """Expect that a drive which hears nothing is told by its time-out; one that never says it is enabled by a stall."""
    never_enabled = phase is Phase.IDLE and protocol_of(config).feedback.enabled is False
    return QUICK if never_enabled else DISABLED


def _after_the_holder(config: Config, phase: Phase) -> str:
    """Expect what ``service.holder_lost`` says of a move; an axis at rest has nothing to stop."""
    policy = {"continue": TOLERATED, "stop": HELD, "disarm": HELD}[config.service.holder_lost]
    return policy if phase in MOVING else TOLERATED


def _after_a_signal(_: Config, phase: Phase) -> str:
    """Expect a controlled stop; of an axis at rest, that a service which is ending refuses what is asked next."""
    return REFUSED if phase in {Phase.IDLE, Phase.HOLDING} else HELD


def _ended(budget: Budget) -> float:
    return budget.stopping(budget.detection_s(0), budget.limits.acceleration)


def _counts(_: DriveProfile, protocol: ProtocolSettings) -> bool:
    return protocol.feedback.counter is not False


_UNCOUNTED = "the drive's feedback has no counter: a repeated or late frame counts as a new one"


def _tells_faults(_: DriveProfile, protocol: ProtocolSettings) -> bool:
    return protocol.feedback.fault is not False or protocol.feedback.fault_code is not False


_HALF = 0.5
"""Gain that takes more evidence than any smaller one, since a plant that speeds up may look like it."""

_LEAST_GAIN = math.sqrt(
    min(plant.gain for plant in ACCEPTED) * max(one.factor for one in OTHER_GAINS if 0.0 < one.factor < _HALF)
)
"""Share of its gain below which a plant is another one, which the model test tells: it is nearer to the hypothesis of
too small a gain (0.45) than to the weakest plant that is accepted (0.7)."""


def _ample_effort(config: Config) -> str:
    """Say why the effort of an axis never saturates in a cruise: what is so weak does not answer as its model says."""
    limits, true = config.axis.limits, config.simulation
    share = abs(limits.velocity * true.pole / true.gain) / limits.effort
    if drive_faults.WEAKNESS * share >= _LEAST_GAIN:
        return ""
    return (
        f"the velocity limit needs {share:.0%} of the effort limit, so only a plant far off its model could need more"
    )


_D, _H, _R = drive_faults, host_faults, resource_faults

TABLE: tuple[Fault, ...] = (
    # The bus
    Fault(1, "one frame lost", bus_faults.lose(1), TOLERATED, _bridged),
    Fault(2, "frames lost in a row, as many as the limit", bus_faults.lose_as_many_as_the_limit, QUICK, _stale,
          idle=TOLERATED, phases=EVERYWHERE),
    Fault(3, "5 % of the frames lost", bus_faults.lose_at_random, TOLERATED, _bridged),
    Fault(4, "frames doubled", bus_faults.double, TOLERATED, _bridged, needs=_counts, reason=_UNCOUNTED),
    Fault(5, "two frames in the wrong order", bus_faults.reorder, TOLERATED, _bridged, needs=_counts,
          reason=_UNCOUNTED),
    Fault(6, "frames 10 to 90 % of a tick late", bus_faults.delay_within_a_tick, TOLERATED, _bridged),
    Fault(7, "a frame more than a tick late", bus_faults.delay_beyond_a_tick, TOLERATED, _bridged),
    Fault(8, "queue full, one command", bus_faults.refuse_to_send(1), TOLERATED, _followed),
    Fault(8, "queue full, two commands", bus_faults.refuse_to_send(2), QUICK,
          lambda budget: budget.quick_stop(budget.detection_s(2)), idle=TOLERATED, shared=True),
    Fault(9, "controller error-passive", bus_faults.error_passive, TOLERATED, _unnoticed, check=bus_error_reported),
    Fault(10, "bus-off", bus_faults.bus_off, DISABLED, _command_timeout, check=came_back_disarmed, idle=TOLERATED,
          shared=True),
    Fault(11, "interface down, or unplugged", bus_faults.interface_down, DISABLED, _command_timeout,
          check=came_back_disarmed, idle=TOLERATED, phases=EVERYWHERE, shared=True),
    Fault(12, "a node babbles", bus_faults.babble, TOLERATED, _unnoticed),
    Fault(12, "backlog: more frames than a tick reads", bus_faults.back_up, QUICK, _stale, phases=EVERYWHERE,
          shared=True, instead=DISABLED, note="the heartbeat is delayed, too"),
    Fault(13, "another node commands the drive", bus_faults.foreign_command, DISABLED, _at_once, idle=REFUSED,
          phases=EVERYWHERE),
    Fault(14, "wrong length, kind and identifier", bus_faults.malformed, TOLERATED, _bridged, check=rejected_some),
    Fault(15, "checksum wrong from now on", bus_faults.corrupt, QUICK, _stale, check=rejected_some,
          needs=lambda _, protocol: protocol.feedback.checksum is not False,
          reason="the drive's feedback has no checksum: only the controllers' own CRC protects its frames"),
    Fault(15, "counter frozen", _D.repeat_counter, QUICK, _stale, needs=_counts,
          reason="the drive's feedback has no counter"),
    Fault(16, "transmit dead, receive alive", bus_faults.transmit_dead, _unheard, _command_timeout,
          note="the drive's own time-out stops it", shared=True),
    # The encoder
    Fault(17, "counter wraps", lambda *_: None, TOLERATED, _unnoticed, prepare=_D.wrap_ahead,
          needs=lambda profile, _: profile.traits.position_period > 0.0,
          reason="the drive's position signal does not wrap"),
    Fault(18, "a single spike", _D.spike, TOLERATED, _bridged),
    Fault(19, "a jump that stays", _D.jump, QUICK, lambda budget: budget.implausible(),
          check=needs_homing, phases=(*EVERYWHERE, *BRAKED), instead=DISABLED,
          note="while disarmed, a jump that `overspeed` allows looks like a push by hand"),
    Fault(20, "value frozen, counter alive", _D.frozen, QUICK, lambda budget: budget.blind_encoder(), idle=QUICK,
          again=True, phases=(*EVERYWHERE, *BRAKED), instead=DISABLED),
    Fault(21, "sign reversed", _D.scaled(-1.0), QUICK, lambda budget: budget.wrong_encoder(), idle=QUICK,
          check=trips_early, again=True, phases=(*EVERYWHERE, *BRAKED), instead=DISABLED, limit=too_slow),
    Fault(22, "scale doubled", _D.scaled(2.0), QUICK, lambda budget: budget.doubled_scale(), idle=QUICK, again=True,
          phases=(*EVERYWHERE, *BRAKED), instead=DISABLED, limit=either(too_slow, hidden_by_noise)),
    Fault(22, "scale halved", _D.scaled(0.5), QUICK, lambda budget: budget.halved_scale(), idle=QUICK, again=True,
          phases=(*EVERYWHERE, *BRAKED), instead=DISABLED,
          limit=either(too_slow, looks_like_the_model(0.5)), limit_bound=lambda budget: budget.hidden_scale()),
    Fault(23, "position invalid", _D.not_a_number, QUICK, _stale, needs=lambda profile, _: profile.traits.says_invalid,
          reason="the drive's position signal has no value that means invalid"),
    Fault(24, "slow drift", _D.drift, TOLERATED, _followed,
          note="cannot be observed with one encoder: the axis follows it"),
    Fault(25, "coarse steps: limit cycle", _D.coarse, TOLERATED, _bridged),
    # Drive and plant
    Fault(26, "fault bit", _D.fault_bit, DISABLED, _at_once, phases=EVERYWHERE, needs=_tells_faults),
    Fault(27, "drive reboots", _D.reboot, DISABLED, _at_once, check=needs_homing,
          needs=lambda profile, protocol: profile.heartbeat_id is not None
          and protocol.heartbeat.boot_counter is not False,
          reason="the drive has no heartbeat that counts its boots"),
    Fault(28, "drive ignores the effort", _D.ignore_effort, QUICK,
          lambda budget: budget.runaway(budget.detection_s(0)), idle=QUICK, again=True,
          instead=DISABLED, note="the quick stop cannot work, so the drive is disabled in the end"),
    Fault(29, "effort saturates: speed unreachable", _D.too_weak,
          {Phase.ACCELERATING: STOPPED, Phase.CRUISING: STOPPED, Phase.HOLDING: STOPPED},
          lambda budget: budget.unreachable_speed(_D.WEAKNESS),
          idle=STOPPED, velocity_limit=True, check=told_in_time, why_not=_ample_effort,
          phases=(Phase.IDLE, Phase.ACCELERATING, Phase.CRUISING, Phase.HOLDING)),
    Fault(30, "stall", _D.stall, QUICK, _unnoticed, idle=QUICK, again=True, check=within_stall_effort),
    Fault(31, "a load steps", _D.load_step, TOLERATED, _followed, phases=ARMED, check=arrived),
    Fault(32, "gain and pole 20 % off, friction", _D.another_plant, TOLERATED, _followed, check=arrived),
    Fault(33, "safe torque off", _D.safe_torque_off, DISABLED, _at_once, check=still_seen,
          needs=lambda _, protocol: protocol.feedback.safe_torque_off is not False),
    Fault(34, "limit switch ahead", _D.limit_switch, {**dict.fromkeys(MOVING, QUICK), Phase.HOLDING: REFUSED},
          lambda budget: budget.quick_stop(budget.detection_s(0)), idle=REFUSED, check=only_off_the_switch,
          needs=lambda _, protocol: protocol.feedback.positive_limit is not False),
    Fault(35, "heartbeat stops", _D.heartbeat_stops, DISABLED, _heartbeat,
          needs=lambda profile, _: profile.heartbeat_id is not None, reason="the drive has no heartbeat"),
    # The host
    Fault(36, "host held up for 15 ms", _H.suspend(0.015), _suspended(0.015), _suspended_travel(0.015)),
    Fault(36, "host held up for 50 ms", _H.suspend(0.050), _suspended(0.050), _suspended_travel(0.050),
          idle_bound=_bridged, phases=EVERYWHERE, shared=True),
    Fault(36, "host held up for 500 ms", _H.suspend(0.500), _suspended(0.500), _suspended_travel(0.500),
          idle_bound=_bridged, phases=EVERYWHERE, shared=True,
          note="longer than the drive's command time-out: it disables itself before the service sees the missed ticks"),
    # The tick in which the defect shows sends no command.
    Fault(40, "a defect in the loop", _H.defect, QUICK,
          lambda budget: budget.quick_stop(budget.detection_s(1)), idle=REFUSED, check=ended_with_an_error,
          shared=True),
    Fault(40, "a defect in a listener of the loop", _H.defect_of_a_publisher, QUICK,
          lambda budget: budget.quick_stop(budget.detection_s(0)), idle=REFUSED, check=ended_with_an_error,
          shared=True),
    Fault(41, "processor hogged: every tick late", _H.hog, TOLERATED, lambda budget: budget.late(_H.LATEST_TICK)),
    # Operator and configuration
    Fault(43, "set-points out of range, NaN, infinite", _H.bad_set_points, REFUSED, _unnoticed, check=refused_all),
    Fault(44, "set-point in mid-move", _H.retarget, TOLERATED, _retargeted, phases=MOVING, check=continuous),
    Fault(45, "two clients", _H.second_client, REFUSED, _unnoticed, check=refused_all),
    Fault(46, "the commanding client dies", _H.client_dies, _after_the_holder, lambda budget: budget.stopping(
        budget.detection_s(0), budget.limits.acceleration), shared=True),
    Fault(49, "reload while armed", _H.reload, REFUSED, _unnoticed, phases=ARMED, check=refused_all),
    # Clock, disk, network
    Fault(50, "wall clock jumps by an hour", _H.wall_clock_jumps, TOLERATED, _unnoticed),
    Fault(51, "disk full", _H.full_disk, TOLERATED, _unnoticed),
    Fault(52, "log sink blocks", _H.blocked_log, TOLERATED, _unnoticed, check=log_dropped),
    Fault(53, "control socket flooded, slow readers", _H.flood, TOLERATED, _unnoticed),
    # A drive that lies about its state
    Fault(55, "drive stays enabled after `disarm`", _D.stays_enabled, DISABLED,
          lambda budget: budget.disarmed(), idle=DISABLED, phases=EVERYWHERE, check=still_enabled_is_told,
          shows_s=lambda config: config.axis.arming_timeout_ms / 1e3 + 4.0 * config.service.tick_ms / 1e3,
          needs=lambda _, protocol: protocol.feedback.enabled is not False),
    Fault(56, "axis moves after `disarm` with its drive off", _D.moves_while_disabled,
          {**dict.fromkeys((*MOVING, *SEARCHING), HELD), Phase.HOLDING: REFUSED}, _disarmed_and_moved, idle=TOLERATED,
          idle_bound=lambda budget: budget.followed() + budget.moved_while_disabled(_D.CREEP_GATES),
          refused_bound=_disarmed_and_moved,
          phases=EVERYWHERE, check=told_how_far, note="it looks like a push by hand: reported, no trip"),
    Fault(57, "heartbeat says fault, feedback does not", _D.contradiction, DISABLED,
          lambda budget: budget.contradicted(), idle=DISABLED, phases=EVERYWHERE, needs=_contradicts),
    Fault(67, "drive switched off and on, boot counter unchanged", _D.restart_with_the_old_boot_counter, QUICK,
          _at_once, phases=EVERYWHERE, prepare=_D.count_away_from_zero, check=right_or_not_trusted, instead=DISABLED),
    # Clients
    Fault(58, "client disconnects during its request", client_faults.leave_too_soon, TOLERATED, _unnoticed,
          phases=EVERYWHERE, check=client_faults.was_dropped),
    Fault(59, "half-closed clients that do not read", client_faults.half_closed, TOLERATED, _unnoticed,
          phases=EVERYWHERE, check=client_faults.serves_others),
    Fault(60, "heavy lines from 55 clients", client_faults.heavy_lines, TOLERATED, _unnoticed,
          phases=EVERYWHERE, check=client_faults.serves_others),
    Fault(66, "old request after a freeze", client_faults.freeze, _suspended(client_faults.FREEZE_S),
          _suspended_travel(client_faults.FREEZE_S), phases=EVERYWHERE, check=client_faults.has_expired, shared=True),
    # The process
    *(
        Fault(61, f"signal {number.name}, twice", _R.receive(number), _after_a_signal, _ended,
              phases=EVERYWHERE, check=_R.ended_with_the_drive_disabled, shared=True)
        for number in (signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1)
    ),
    Fault(62, "a trip with no file descriptor left", _R.no_descriptor_left, DISABLED, _at_once, idle=REFUSED,
          phases=EVERYWHERE, check=_R.told_that_no_descriptor_is_left),
    Fault(63, "a trip with no thread available", _R.no_thread_left, DISABLED, _at_once, idle=REFUSED,
          phases=EVERYWHERE, check=_R.wrote_the_trip),
    Fault(64, "a trip with no memory to record it", _R.no_memory_left, DISABLED, _at_once, idle=REFUSED,
          phases=EVERYWHERE, check=_R.told_that_no_memory_is_left),
    Fault(65, "control socket deleted", _R.delete_socket, TOLERATED, _unnoticed, phases=EVERYWHERE,
          check=_R.is_served_again),
)  # fmt: skip
"""All but the faults that need processes (37, 38, 39, 42, 54), and those of the configuration (47, 48)."""
