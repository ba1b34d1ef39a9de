"""The paper's equations as they are read here, in LaTeX, for the report."""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Equation:
    """One equation as read: its number in the paper, LaTeX, and the errata that went into it."""

    tag: str
    latex: str
    errata: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Passage:
    """Some equations that belong together, and what they say."""

    title: str
    text: str
    equations: tuple[Equation, ...]


PASSAGES: Final = (
    Passage(
        "Plant, sampled with a zero-order hold",
        "Effort u in V, position y = x1 in mm, velocity x2 in mm/s; T_s = 10 ms.",
        (
            Equation("35", r"G(s) = \frac{180}{s (s + 14)}"),
            Equation("38", r"G(s) = \frac{180 \cdot 1.3}{s (s + 14 \cdot 0.7)} \quad \text{(driven in Example 2)}"),
            Equation("1, 2", r"x(k+1) = A x(k) + B u(k), \quad y(k) = C x(k)"),
        ),
    ),
    Passage(
        "Optimal servo",
        "Incremental state, error included; the gains are those of the Riccati equation of this cost.",
        (
            Equation("7", r"x_p(k) = \begin{matrix} \Delta x(k) \\ e(k-1) \end{matrix}"),
            Equation(
                "8, 10",
                r"x_p(k+1) = \begin{matrix} A & 0 \\ -C & 1 \end{matrix} x_p(k) "
                r"+ \begin{matrix} B \\ 0 \end{matrix} \Delta u(k)",
            ),
            Equation(
                "11",
                r"J = \sum_{k=0}^{\infty} x_p^T Q x_p + R \, \Delta u^2, \quad Q = q \, \mathrm{diag}(1, 0, 1)",
                (1, 3),
            ),
            Equation("12", r"\Delta u(k) = -f_{11} \Delta x_1(k) - f_{12} \Delta x_2(k) + f_{22} e(k-1)", (2,)),
        ),
    ),
    Passage(
        "Two stages, conventional",
        "The speed stage needs a measured velocity; the position stage runs on a model of the plant, started when "
        "the distance p remains.",
        (
            Equation("14", r"u(k) = -f_{12} x_2(k) + I(k), \quad I(k) = f_{22} \sum_{i=0}^{k-1} (v - x_2(i))", (2, 10)),
            Equation(
                "15",
                r"u(k+1) = -f_{11} x_{m1}(k+1) - f_{12} x_{m2}(k+1) + I(k) + f_{22} e(k)",
                (2, 10, 14),
            ),
            Equation("16, 17", r"x_m(k+1) = \begin{matrix} v T_s \\ v \end{matrix}", (4,)),
            Equation("18, 19", r"p = r(k) - y(k) = \frac{f_{11} v T_s}{f_{22}}"),
        ),
    ),
    Passage(
        "Disturbance observer",
        "A steady-state Kalman filter over position, velocity and disturbance, in the predictor form.",
        (
            Equation(
                "25",
                r"A_o = \begin{matrix} A & B \\ 0 & 1 \end{matrix}, \quad "
                r"B_o = \begin{matrix} B \\ 0 \end{matrix}, \quad C_o = \begin{matrix} 1 & 0 & 0 \end{matrix}",
                (5, 8),
            ),
            Equation("26", r"x_o(k+1) = A_o x_o(k) + B_o u(k) + A_o K (y(k) - C_o x_o(k))", (6,)),
            Equation("27", r"K = X C_o^T (C_o X C_o^T + R_o)^{-1}"),
            Equation(
                "28",
                r"A_o X A_o^T - A_o X C_o^T (C_o X C_o^T + R_o)^{-1} C_o X A_o^T + G W G^T - X = 0",
                (7,),
            ),
            Equation("37", r"G W G^T = 0.1 \, I_3, \quad R_o = 0.01", (8,)),
        ),
    ),
    Passage(
        "Two stages, proposed",
        "One sum I runs through both stages. M makes the two forms equal at the tick of the change-over.",
        (
            Equation("29", r"u(k) = I(k) - f_{12} x_{o2}(k), \quad I(k+1) = I(k) + f_{22} (v - x_{o2}(k))", (2, 10)),
            Equation(
                "30, 33",
                r"u(k) = I(k) - f_{11} (x_{o1}(k) + M) - f_{12} x_{o2}(k), \quad I(k+1) = I(k) + f_{22} (r - y(k))",
                (2, 10, 11),
            ),
            Equation("32", r"M = -x_{o1}(k_c) \quad \text{at the change-over } k_c", (12,)),
        ),
    ),
)
