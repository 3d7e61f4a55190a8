# SPDX-License-Identifier: Apache-2.0
"""
Real-time nonlinear model predictive control: numbers in, numbers out.

Data flows one way: model, ocp, linearization, riccati, active_set, rti. A QP that the
active set cannot solve, or for which another solver is asked for, takes the side branch:
transcription, qp, solver. The controller uses rti; the wire is independent of it. Names
are imported on first use, so that a process which only uses the wire contract loads
neither CasADi nor OSQP.

Public names: `Model` and `Signal` describe a robot, `find_model` finds one that ships,
`Ocp` is the problem, `Rti` solves one sample of it, `simulate` closes the loop, `plot` and
`compare` show what came of it, and `Controller` does so in the robot's time and handles
everything that may go wrong: with the delays and timeouts of a `Timing` it takes each
`State` and `Reference`, which says by `End` what follows its last row, and returns each
`Command`.

Example:
    >>> from rti_mpc import Ocp, Rti, find_model
    >>> ocp = Ocp(find_model("pioneer_3dx"), N=20, dt=0.1, Q=[1, 1, 0.05], R=[1, 1], lbu=-0.5, ubu=0.5)
    >>> rti = Rti(ocp, compile=False)
    >>> rti.prepare(y_ref=rti.y_ref + [1.0, 0.0, 0.0])  # before the state is there: shift, linearize, factorize
    >>> rti.feedback(x0=rti.x[0])  # once it is: embed the state, solve
    <QpStatus.SOLVED: 0>
    >>> rti.u[0].shape  # the command
    (2,)

References, cited by key throughout:

* [Rosales] A. Rosales Acosta, "Dynamic nonlinear model based predictive control for mobile robots".
* [DeLaCruz2006] C. De La Cruz, R. Carelli, "Dynamic modeling and centralized formation control of mobile robots", IECON 2006.
* [Diehl2005] M. Diehl, H. G. Bock, J. P. Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback control",
  SIAM J. Control Optim. 43(5), 2005.
* [Gros2020] S. Gros, M. Zanon, R. Quirynen, A. Bemporad, M. Diehl, "From linear to nonlinear MPC: bridging the gap via the real-time iteration",
  Int. J. Control 93(1), 2020.
* [Verschueren2022] R. Verschueren et al., "acados - a modular open-source framework for fast embedded optimal control", Math. Prog. Comp. 14, 2022.
* [Wirsching2006] L. Wirsching, H. G. Bock, M. Diehl, "Fast NMPC of a chain of masses connected by springs", IEEE CCA, 2006.
* [Altafini2001] C. Altafini, A. Speranzon, B. Wahlberg, "A feedback control scheme for reversing a truck and trailer vehicle", IEEE Trans. Robot.
  Autom. 17(6), 2001.
* [Andersson2013] J. Andersson, "A general-purpose software framework for dynamic optimization", PhD thesis, KU Leuven, 2013.
* [Barzilai1988] J. Barzilai, J. M. Borwein, "Two-point step size gradient methods", IMA J. Numer. Anal. 8(1), 1988.
* [Irons1969] B. M. Irons, R. C. Tuck, "A version of the Aitken accelerator for computer iteration", Int. J. Numer. Methods Eng. 1(3), 1969.
* [Ghadimi2015] E. Ghadimi, A. Teixeira, I. Shames, M. Johansson, "Optimal parameter selection for the alternating direction method of
  multipliers (ADMM): quadratic problems", IEEE Trans. Autom. Control 60(3), 2015.
* [Sola2017] J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017.
* [Stellato2020] B. Stellato et al., "OSQP: an operator splitting solver for quadratic programs", Math. Prog. Comp. 12, 2020.
* [FanYuan2005] J. Fan, Y. Yuan, "On the quadratic convergence of the Levenberg-Marquardt method without nonsingularity assumption", Computing 74,
  2005.
* [Hintermueller2003] M. Hintermüller, K. Ito, K. Kunisch, "The primal-dual active set strategy as a semismooth Newton method", SIAM J. Optim. 13(3),
  2003.
* [Ferreau2008] H. J. Ferreau, H. G. Bock, M. Diehl, "An online active set strategy to overcome the limitations of explicit MPC", Int. J. Robust and
  Nonlinear Control 18(8), 2008.
* [Bland1977] R. G. Bland, "New finite pivoting rules for the simplex method", Mathematics of Operations Research 2 (2), 1977.
* [Mehrotra1992] S. Mehrotra, "On the implementation of a primal-dual interior point method", SIAM J. Optim. 2(4), 1992.
* [Kapania2016] N. Kapania, J. Subosits, J. C. Gerdes, "A sequential two-step algorithm for fast generation of vehicle racing trajectories",
  J. Dyn. Sys. Meas. Control 138(9), 2016.
* [Lam2010] D. Lam, C. Manzie, M. Good, "Model predictive contouring control", CDC 2010.
* [Faulwasser2016] T. Faulwasser, R. Findeisen, "Nonlinear model predictive control for constrained output path following", IEEE Trans. Autom.
  Control 61(4), 2016.
* [Liniger2015] A. Liniger, A. Domahidi, M. Morari, "Optimization-based autonomous racing of 1:43 scale RC cars", Optim. Control Appl. Methods 36(5),
  2015.
* [Pacejka2012] H. B. Pacejka, "Tire and vehicle dynamics", 3rd ed., Butterworth-Heinemann, 2012.
* [HairerWanner1996] E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II: Stiff and Differential-Algebraic Problems*, Springer, 1996.
* [Pannocchia2003] G. Pannocchia, J. B. Rawlings, "Disturbance models for offset-free model-predictive control", AIChE J. 49(2), 2003.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rti_mpc.contract.message import Command as Command
    from rti_mpc.contract.message import End as End
    from rti_mpc.contract.message import Reference as Reference
    from rti_mpc.contract.message import State as State
    from rti_mpc.control.controller import Controller as Controller
    from rti_mpc.control.grid import Timing as Timing
    from rti_mpc.model.find import find_model as find_model
    from rti_mpc.model.model import Model as Model
    from rti_mpc.model.model import Signal as Signal
    from rti_mpc.rti.ocp import Ocp as Ocp
    from rti_mpc.rti.plot import plot as plot
    from rti_mpc.rti.rti import Rti as Rti
    from rti_mpc.rti.simulation import compare as compare
    from rti_mpc.rti.simulation import simulate as simulate

MODULE_OF_NAME = {
    "Command": "rti_mpc.contract.message",
    "Controller": "rti_mpc.control.controller",
    "End": "rti_mpc.contract.message",
    "Model": "rti_mpc.model.model",
    "Ocp": "rti_mpc.rti.ocp",
    "Reference": "rti_mpc.contract.message",
    "Rti": "rti_mpc.rti.rti",
    "Signal": "rti_mpc.model.model",
    "State": "rti_mpc.contract.message",
    "Timing": "rti_mpc.control.grid",
    "compare": "rti_mpc.rti.simulation",
    "find_model": "rti_mpc.model.find",
    "plot": "rti_mpc.rti.plot",
    "simulate": "rti_mpc.rti.simulation",
}

__version__ = "0.1.0"
__all__ = [
    "Command",
    "Controller",
    "End",
    "Model",
    "Ocp",
    "Reference",
    "Rti",
    "Signal",
    "State",
    "Timing",
    "__version__",
    "compare",
    "find_model",
    "plot",
    "simulate",
]


def __getattr__(name: str) -> Any:
    """Import a public name from its module on first use (PEP 562)."""
    if name not in MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(MODULE_OF_NAME[name]), name)


def __dir__() -> list[str]:
    """Return the public names, those that are not imported yet included."""
    return __all__
