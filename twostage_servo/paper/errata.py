"""The paper's slips: what is printed, what it is read as, why, and what the print would do.

One list for everybody: the report and ``docs/law.md`` are made from it, and each entry that changes a number names the
law, as printed, that shows by how much.
"""

from dataclasses import dataclass
from typing import Final

from twostage_servo.control.baselines.conventional import ConventionalTwoStage
from twostage_servo.control.baselines.transcription import Reading, TranscribedLaw
from twostage_servo.control.baselines.velocity import speed_sensor
from twostage_servo.paper.examples import EXAMPLE_1
from twostage_servo.paper.methods import Builder, transcribed


@dataclass(frozen=True, slots=True)
class Erratum:
    """One slip.

    Attributes
    ----------
    number
        Its number here and in the code's comments.
    where
        Equation or section of the paper.
    printed, read_as, why, effect
        For people; formulas in Unicode.
    as_printed
        Builds the law with this one slip as printed; None where no number of a run depends on it.
    noise_variance
        Noise of the run as printed, in mm², where that is the slip.
    baseline
        The method that `as_printed` is compared with.
    """

    number: int
    where: str
    printed: str
    read_as: str
    why: str
    effect: str
    as_printed: Builder | None = None
    noise_variance: float | None = None
    baseline: str = "proposed"


ERRATA: Final = (
    Erratum(
        1,
        "(11)",
        "cost on Δx_p",
        "cost on x_p",
        "x_p = [Δx; e] is incremental already",
        "no gains exist: a constant error costs nothing, f22 is 0 and a pole stays at z = 1",
        transcribed(Reading(cost="increment")),
    ),
    Erratum(
        2,
        "(12), (14), (15), (29), (30), (33), (34)",
        "+ f11 x1 + f12 x2",
        "- f11 x1 - f12 x2 + f22 Σe",
        "the gains printed in (36) are positive, and feedback has to oppose the motion",
        "positive feedback: the axis runs away",
        transcribed(Reading(feedback_sign=1)),
    ),
    Erratum(
        3,
        "(36)",
        "Q/R = 5.0e-5, no matrix Q",
        "Q = q·diag(1, 0, 1), R = 1",
        "equal weight on Δy and e reproduces every printed digit of (36). Any diag(w, 0, 1) with w from 0.6 to 4.2 "
        "does that, and 1 is the simplest choice; weight on e alone gives f11 = 3.77e-1, weight on all three states "
        "f12 = 2.35e-2",
        "small: f11 changes by 0.02 % in Example 1 and by 0.13 % in Example 2 (with weight on e alone)",
        transcribed(Reading(weights=(0.0, 0.0, 1.0))),
    ),
    Erratum(
        4,
        "(17)",
        "v T_c",
        "v T_s",
        "T_c is defined nowhere; one sampling period after the change-over the axis has gone v T_s",
        "none: a misprint",
    ),
    Erratum(
        5,
        "(25)",
        "lower right entry of A_o is 0",
        "1 (disturbance_memory)",
        "0 is a disturbance that is forgotten every tick and never estimated; 1 is the random walk of every "
        "disturbance observer",
        "what the model does not explain makes the estimated velocity wrong. Example 2: the speed stage swings up to "
        "230 mm/s and then cruises at 184, where the estimate says 100. Example 1, where the model is perfect, has a "
        "quieter estimate; but a load of 1 V makes it cruise 12.7 mm/s off its speed",
        transcribed(Reading(disturbance_memory=0.0)),
    ),
    Erratum(
        6,
        "(26), (27)",
        "K of (27) in (26)",
        "A_o K in (26)",
        "(26) is the predictor form, (27) the gain of the filter form; the predictor's is A_o K",
        "small here: A_o K and K differ by a tick of motion, a tenth in the gain on position. The smaller printed gain "
        "is a little quieter, and no gain is optimal for noise that (37) does not describe (erratum 16)",
        transcribed(Reading(observer_form="mixed")),
    ),
    Erratum(
        7,
        "(28)",
        "no - X",
        "A_o X A_o' - A_o X C_o' (C_o X C_o' + R_o)⁻¹ C_o X A_o' + G W G' - X = 0",
        "the covariance of a steady state reproduces itself",
        "no covariance solves it: for X >= 0 the left side is at least G W G', and never 0",
        transcribed(Reading(covariance="as printed")),
    ),
    Erratum(
        8,
        "(22), (37)",
        "G W G' = 0.1, G_o = B_o",
        "G W G' = 0.1·I(3), the column G_o = B",
        "a number is not a 3 by 3 matrix, and B_o of (25) has 3 rows where G_o needs 2. With noise on "
        "all three states the claims of both examples hold; with noise on the disturbance alone they do not",
        "read as diag(0, 0, 0.1): the speed stage of Example 2 is unstable, thousands of mm/s, and ends only because "
        "the change-over comes",
        transcribed(Reading(process_variance=(0.0, 0.0, 0.1))),
    ),
    Erratum(
        9,
        "Example 1",
        "white noise of power 1.0e-5",
        "variance 1e-3 mm²",
        "the power of a band-limited white noise block is a density: variance = power / T_s",
        "a variance of 1e-5 mm² would make every velocity ten times quieter, the differentiated one too",
        transcribed(Reading()),
        noise_variance=1e-5,
    ),
    Erratum(
        10,
        "(14), Fig. 1",
        "Σe in both stages",
        "Σ(v - x_o2) in the speed stage, Σ(r - y) in the position stage, one sum through both",
        "C_m' = [0 1 0] in Fig. 1 picks the velocity; with e = r - y of (3) there is no speed control",
        "the velocity follows the remaining distance, not v: thousands of mm/s instead of a hundred",
        transcribed(Reading(speed_stage_sum="position error")),
    ),
    Erratum(
        11,
        "(33)",
        "F_2 M",
        "F_1 M",
        "M shifts a position, and F_1 is what multiplies positions",
        "the effort jumps by nearly f11 (r - p) at the change-over: over a hundred volts",
        transcribed(Reading(offset_gain="F2")),
    ),
    Erratum(
        12,
        "(31)-(34)",
        "M = -[r - p, 0]",
        "M = -[x_o1, 0, 0], taken at the tick of the change-over",
        "the change-over falls up to one tick beyond p; the printed M takes it to be exactly there, and has two "
        "entries where x_o has three",
        "a step of the effort of up to f11 v T_s, and an overshoot that depends on where within a tick the change-over "
        "falls",
        transcribed(Reading(offset="set-point")),
    ),
    Erratum(
        13,
        "Example 2",
        "Q/R = 5.0e-3, no gains",
        "as printed",
        "not Example 1's ratio: the gains of (36) are not those of Example 2",
        "none: gains 1.430, 0.0689, 0.0663 and p = 21.6 mm, against 54.5 mm in Example 1",
    ),
    Erratum(
        14,
        "(15)",
        "Σ to k - 1 in u_p(k+1)",
        "Σ to k, as in (33), whose + f22 p is e(k)",
        "f22 p cancels f11 v T_s: that is how (19) arises",
        "the conventional law's effort falls by f11 v T_s at the change-over",
        lambda example, sensor: ConventionalTwoStage(
            example.model, example.gains, speed_sensor(sensor), sum_as_printed=True
        ),
        baseline="conventional_two_output",
    ),
    Erratum(
        15,
        "(20), (22), (24)",
        "w for the noise on the plant, for that of the extended model, and for the third state",
        "two noises, and the disturbance as the third state",
        "a state cannot be its own driving noise; (28) has a noise on each of the three states",
        "none: one name for three things",
    ),
    Erratum(
        16,
        "(27), (28), (37), Example 1",
        "R_o and W are power spectral densities; R_o = 0.01 with noise of power 1.0e-5",
        "covariances of the sampled noises; R_o = 0.01 mm², as printed",
        "a sampled Riccati equation needs covariances. The noise of Example 1 then has a tenth of the variance that "
        "the filter is designed for (erratum 9)",
        "small: with R_o = 1e-3, the noise's own variance, the estimated velocity of Example 1 is 8 % noisier",
        lambda example, _: TranscribedLaw(example.model, example.ratio, EXAMPLE_1.noise_variance),
    ),
    Erratum(
        17,
        "(18)",
        "the change-over is where r - y(k) = p",
        "the first tick at which r - x_o1(k) <= p",
        "y is sampled and noisy: equality is never met, and the first sample within p comes early by the noise. The "
        "estimate is of this tick and quieter",
        "small: the change-over moves by a tick or so",
        transcribed(Reading(changeover_on="sample")),
    ),
)


def errata_table() -> str:
    """Return the list as a Markdown table, as it stands in ``docs/law.md``."""
    rows = (
        (str(erratum.number), erratum.where, erratum.printed, erratum.read_as, erratum.why, erratum.effect)
        for erratum in ERRATA
    )
    lines = (" | ".join(row) for row in (("no.", "where", "printed", "read as", "why", "effect"), *rows))
    head, *body = (f"| {line} |" for line in lines)
    return "\n".join((head, "|---|---|---|---|---|---|", *body))
