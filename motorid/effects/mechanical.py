"""Effects on the torque balance: friction, load, angle-dependent torque."""

import math

import casadi as ca

from motorid.model.definition import P, effect
from motorid.model.equations import Equations

QUARTERS = (0.0, math.pi / 2, math.pi, 3 * math.pi / 2)  # of a turn
# What several effects declare alike.
ORDER = P(12.0, "", order=True, vary=False, lower=1.0, doc="periods per turn, from the misfit, then fixed")
PHASE = P(0.0, "rad", periodic=True, doc="phase at theta = 0")
SHARE = P(0.3, "", null=0.0, lower=0.0, upper=0.98, grid=(0.3, 0.7), doc="load's share of the inertia")
DRAG = P(1e-6, "N·m·s/rad", lower=0.0, grid=(0.003, 0.1), doc="viscous friction of the load")


@effect(balance="torque")
def coulomb(m: Equations, tau_c=P(2e-3, "N·m", null=0.0, lower=0.0, doc="Coulomb friction torque")):
    """Dry (Coulomb) friction, tau_c·sgn(omega). Armstrong-Hélouvry et al., Automatica 30(7), 1994."""
    m.torque -= tau_c * m.sign(m.omega)


@effect(balance="torque", includes=("coulomb",))
def coulomb_asymmetric(m: Equations, tau_cp=P(2e-3, "N·m", null=0.0, lower=0.0, doc="Coulomb friction turning forward"),
                       tau_cn=P(2e-3, "N·m", null=0.0, lower=0.0, doc="Coulomb friction turning backward")):
    """Dry friction that differs with the direction. Armstrong-Hélouvry et al., Automatica 30(7), 1994."""
    s = m.sign(m.omega)
    m.torque -= s * (tau_cp * (1 + s) + tau_cn * (1 - s)) / 2


@effect(balance="torque", includes=("coulomb", "coulomb_asymmetric"))
def stribeck(m: Equations, tau_c=P(2e-3, "N·m", null=0.0, lower=0.0, doc="Coulomb friction torque at speed"),
             tau_s=P(3e-3, "N·m", null=0.0, lower=0.0, at_least="tau_c", doc="breakaway torque"),
             omega_s=P(5.0, "rad/s", positive=True, grid=(0.01, 0.03, 0.1, 0.3), doc="Stribeck speed")):
    """Friction with breakaway (Stribeck), (tau_c + (tau_s−tau_c)·exp(−(ω/ω_s)²))·sgn ω. Armstrong et al., 1994."""
    m.torque -= (tau_c + (tau_s - tau_c) * ca.exp(-((m.omega / omega_s) ** 2))) * m.sign(m.omega)


@effect(balance="torque", includes=("coulomb", "coulomb_asymmetric", "stribeck"))
def lugre(m: Equations, tau_c=P(2e-3, "N·m", null=0.0, lower=0.0, doc="Coulomb friction torque at speed"),
          s_b=P(1.5, "", lower=1.0, upper=10.0, doc="breakaway over Coulomb torque"),
          omega_s=P(5.0, "rad/s", positive=True, grid=(0.03, 0.1), doc="Stribeck speed"),
          theta_s=P(0.01, "rad", positive=True, grid=(0.003, 0.03), doc="presliding angle tau_c/σ0")):
    """Bristle friction with presliding (LuGre). Canudas de Wit et al., IEEE TAC 40(3), 1995.

    The bristle damping σ1 is σ0 times the time to cross the presliding angle at the Stribeck speed."""
    level = 1 + (s_b - 1) * ca.exp(-((m.omega / omega_s) ** 2))  # g(ω)/tau_c
    z = m.state("z_bristle")  # deflection over the presliding angle
    rate = (m.omega - ca.fabs(m.omega) * z / level) / theta_s
    m.rate(z, rate)
    m.torque -= tau_c * (z + theta_s / omega_s * rate)


@effect(balance="torque", includes=("coulomb",))
def angular_friction(m: Equations, tau_m=P(2e-3, "N·m", null=0.0, lower=0.0, doc="friction torque, mean over a turn"),
                     a_f=P(0.5, "", lower=0.0, upper=1.0, doc="relative amplitude"),
                     N_f=P(1.0, "", vary=False, lower=1.0, grid=(1.0, 2.0), doc="periods per turn, fixed"),
                     phi_f=P(0.0, "rad", periodic=True, grid=QUARTERS, doc="phase at theta = 0")):
    """Friction that varies over a turn (a bent shaft), τ(1+a·sin(Nθ+φ))·sgn ω. Armstrong-Hélouvry, 1991.

    Seen as a friction that repeats every turn, both ways: turn slowly, with the angle. Once or twice a turn (N_f)."""
    m.torque -= tau_m * (1 + a_f * ca.sin(N_f * m.theta + phi_f)) * m.sign(m.omega)


@effect(balance="torque")
def viscous_asymmetric(m: Equations, b_a=P(1e-6, "N·m·s/rad", null=0.0,
                                           doc="added to b turning forward, taken from it turning backward")):
    """Viscous friction that differs with the direction, b_a·abs(ω). Janot et al., EMPS benchmark, 2019."""
    m.torque -= b_a * m.omega * m.sign(m.omega)


@effect(balance="torque")
def quadratic_drag(m: Equations, c_2=P(1e-7, "N·m·s²/rad²", null=0.0, lower=0.0, doc="drag coefficient")):
    """Fan or windage drag, c_2·ω·abs(ω). White, Fluid Mechanics, 2011."""
    m.torque -= c_2 * m.omega * ca.fabs(m.omega)


@effect(balance="torque")
def eddy_brake(m: Equations, c_e=P(1e-5, "N·m·s/rad", null=0.0, lower=0.0, doc="drag per speed when slow"),
               omega_b=P(50.0, "rad/s", positive=True, grid=(0.1, 0.3, 0.8), doc="speed of the largest torque")):
    """Eddy-current brake, c·ω/(1+(ω/ω_b)²). Wouterse, IEE Proc. B 138(4), 1991.

    Seen as a drag that rises and then falls with the speed: a staircase up to full speed."""
    m.torque -= c_e * m.omega / (1 + (m.omega / omega_b) ** 2)


@effect(balance="torque")
def load_friction(m: Equations, mu=P(0.1, "", null=0.0, lower=0.0, upper=1.0, doc="share of the motor torque lost")):
    """Friction that grows with the torque carried, μ·abs(K·i)·sgn ω. Duclusaud et al., BAM, 2025."""
    m.torque -= mu * ca.fabs(m.K_t * m.i if "i" in m.states else m.g * m.v) * m.sign(m.omega)


@effect(balance="torque", includes=("load_friction",))
def gear_efficiency(m: Equations, mu_d=P(0.1, "", null=0.0, lower=0.0, upper=1.0, doc="share lost when it drives"),
                    mu_b=P(0.2, "", null=0.0, lower=0.0, doc="share lost when it is driven back")):
    """Efficiency of the gear, another share of the torque when driven back. Wang & Kim, ICRA, 2015.

    Only with J fixed are both shares determined, else `load_friction` does as well. Seen in hard braking, starting."""
    carried, s = m.K_t * m.i if "i" in m.states else m.g * m.v, m.sign(m.omega)
    m.torque -= s * (mu_d * (ca.fabs(carried) + carried * s) + mu_b * (ca.fabs(carried) - carried * s)) / 2


@effect(balance="torque")
def constant_load(m: Equations, tau_0=P(1e-3, "N·m", null=0.0, doc="load torque against positive speed")):
    """Constant load torque: a hoist, the offset of a drive. Janot et al., EMPS benchmark, 2019."""
    m.torque -= tau_0


@effect(balance="torque")
def gravity(m: Equations, mgl=P(1e-3, "N·m", null=0.0, lower=0.0, doc="weight times lever arm"),
            phi_g=P(0.0, "rad", periodic=True, doc="angle of the lever at theta = 0, from hanging")):
    """Gravity on an unbalanced load, m·g·l·sin(θ+φ). Any textbook of mechanics; Duclusaud et al., BAM, 2025."""
    m.torque -= mgl * ca.sin(m.theta + phi_g)


@effect(balance="torque")
def spring(m: Equations, k_s=P(1e-3, "N·m/rad", null=0.0, lower=0.0, doc="stiffness"),
           theta_0=P(0.0, "rad", doc="angle at which it is relaxed")):
    """Spring to the frame (a return spring, a flexure), k·(θ−θ₀). Meirovitch, Fundamentals of Vibrations, 2001.

    Seen as an angle that comes back at 0 V: small steps from rest, angle measured."""
    m.torque -= k_s * (m.theta - theta_0)


@effect(balance="torque")
def end_stop(m: Equations, k_stop=P(1e-2, "N·m/rad", null=0.0, lower=0.0, doc="stiffness of the stops"),
             theta_lo=P(-1.0, "rad", place=True, grid=(0.02, 0.1, 0.3), doc="angle of the lower stop"),
             theta_hi=P(1.0, "rad", place=True, grid=(0.98, 0.9, 0.7), doc="angle of the upper stop"),
             d_stop=P(0.01, "s/rad", lower=0.0, grid=(0.3,), doc="damping of an impact, over its stiffness")):
    """End stops of the travel, k·x·(1+d·dx/dt) at x beyond one. Hunt & Crossley, J. Appl. Mech. 42(2), 1975.

    Seen as an angle that goes no further at any voltage: drive to both ends; a stop never reached is not determined."""
    above, below = ca.fmax(m.theta - theta_hi, 0), ca.fmax(theta_lo - m.theta, 0)
    m.torque -= k_stop * (above * ca.fmax(1 + d_stop * m.omega, 0) - below * ca.fmax(1 - d_stop * m.omega, 0))


@effect(balance="torque")
def cogging(m: Equations, A=P(1e-3, "N·m", null=0.0, lower=0.0, doc="amplitude of the cogging torque"), N=ORDER,
            phi=PHASE):
    """Cogging torque, A·sin(N·θ+φ). Hendershot & Miller, Brushless Permanent-Magnet Machines, 2010."""
    m.torque -= A * ca.sin(N * m.theta + phi)


@effect(balance="torque")
def torque_ripple(m: Equations, a_r=P(0.05, "", null=0.0, lower=0.0, upper=0.5, doc="relative amplitude"), N_r=ORDER,
                  phi_r=PHASE, e_r=P(0.0, "", vary=False, lower=0.0, upper=1.0, grid=(0.0, 1.0),
                                     doc="1: in the back-EMF too, fixed")):
    """Torque ripple, K·i·(1+a·sin(N·θ+φ)), with e_r = 1 in the back-EMF too. Jahns & Soong, IEEE TIE 43(2), 1996.

    What suits is taken, unless given. A model without a current has its torque constant g ripple."""
    wave = a_r * ca.sin(N_r * m.theta + phi_r)
    m.scale("K_t" if "i" in m.states else "g", 1 + wave)
    if "i" in m.states:
        m.scale("K_e", 1 + e_r * wave)


CORNER = 0.01  # of half a gap: a stiff shaft is twisted by much less than the gap, and a wide corner is a soft shaft,
WIDE = 0.1  # rad: which a corner wider than a thousandth of a radian is, however large the gap


def _two_inertias(m: Equations, share, resonance, zeta, twist_of, name: str) -> tuple[ca.SX, ca.SX]:
    """Split J into motor and load joined by a shaft, return its twist and slip; `twist_of` shapes the elastic twist.

    The total stays J. With load share r, stiffness ω_r²·J·r·(1−r), damping 2·ζ·ω_r·J·r·(1−r), all vanishes as r → 0."""
    twist, omega_load = m.state(f"twist_{name}"), m.state(f"omega_{name}", m.start["omega"])
    slip = m.omega - omega_load
    elastic, contact = twist_of(twist)
    # Shaft torque over J·r:
    per_share = (1 - share) * (resonance**2 * elastic + 2 * zeta * resonance * contact * slip)
    m.rate(twist, slip)
    m.rate(omega_load, per_share)
    m.scale("J", 1 - share)
    m.torque -= m.symbols["J"] * share * per_share
    return twist, slip


@effect(balance="transmission")
def compliance(m: Equations, r_load=SHARE,
               omega_r=P(200.0, "1/s", positive=True, grid=(0.02, 0.06, 0.2, 0.6), doc="resonance of the two inertias"),
               zeta_r=P(0.05, "", positive=True, upper=2.0, grid=(0.05, 0.3), doc="damping ratio of the resonance")):
    """Elastic shaft between two inertias. Ellis, Control System Design Guide, ch. 16, 2012."""
    _two_inertias(m, r_load, omega_r, zeta_r, lambda twist: (twist, 1.0), "load")


@effect(balance="transmission")
def compliance_load_side(m: Equations, T_far=P(5e-3, "s", null=0.0, positive=True, grid=(2.0, 5.0, 15.0, 50.0),
                                               doc="1/resonance of the two inertias"),
                         r_far=P(0.5, "", positive=True, upper=0.98, grid=(0.5,), doc="load's share of the inertia"),
                         zeta_far=P(0.1, "", positive=True, upper=2.0, grid=(0.1,), doc="damping of the resonance")):
    """Speed and angle sensed behind an elastic shaft, at its load. Ellis, Control System Design Guide, ch. 16, 2012."""
    twist, slip = _two_inertias(m, r_far, 1 / T_far, zeta_far, lambda twist: (twist, 1.0), "far")
    m.measure("omega", m.measured("omega") - slip)
    m.measure("theta", m.measured("theta") - twist)


@effect(balance="transmission", includes=("compliance",))
def backlash(m: Equations, r_gap=SHARE,
             gap=P(0.02, "rad", positive=True, grid=(0.001, 0.01, 0.03, 0.1, 1.0), doc="total free play"),
             omega_c=P(500.0, "1/s", positive=True, grid=(0.1, 0.4), doc="resonance while in contact"),
             zeta_c=P(0.2, "", positive=True, upper=2.0, grid=(0.1, 0.5), doc="damping ratio while in contact")):
    """Backlash between two inertias, elastic in contact. Nordin & Gutman, Automatica 38(10), 2002."""
    half = gap / 2
    width = CORNER * half / (1 + half / WIDE)

    def in_contact(twist):
        # Smooth dead zone (softplus of square-root type) and its slope.
        up, down = twist - half, twist + half
        soft_up, soft_down = ca.sqrt(up**2 + width**2), ca.sqrt(down**2 + width**2)
        return twist + (soft_up - soft_down) / 2, 1 + (up / soft_up - down / soft_down) / 2

    _two_inertias(m, r_gap, omega_c, zeta_c, in_contact, "geared")


LEAST = 1e-6  # share of the inertia, so that a load of none is not driven infinitely fast


def _driven_load(m: Equations, share, drag, torque, name: str) -> None:
    """Split J into the motor and a load with a viscous friction of its own; `torque` is that of their difference."""
    omega_load, inertia = m.state(f"omega_{name}", m.start["omega"]), m.symbols["J"] * (share + LEAST)
    carried = torque(m.omega - omega_load)
    m.rate(omega_load, (carried - drag * omega_load) / inertia)
    m.scale("J", 1 - share)
    m.torque -= m.symbols["J"] * share * carried / inertia


@effect(balance="transmission")
def slip_clutch(m: Equations, r_slip=SHARE,
                tau_slip=P(0.01, "N·m", positive=True, grid=(0.1, 0.3, 0.6), doc="largest torque that it carries"),
                omega_slip=P(1.0, "rad/s", positive=True, grid=(0.01,), doc="slip at 3/4 of that"), b_slip=DRAG):
    """Load driven by friction that may slip, τ·tanh(Δω/ω_s): a clutch, a belt, a wheel. Awrejcewicz & Olejnik, 2005.

    Seen as a motor that runs up too fast with hard steps and not with soft ones: ramps and steps of several sizes."""
    _driven_load(m, r_slip, b_slip, lambda slip: tau_slip * ca.tanh(slip / omega_slip), "slip")


@effect(balance="transmission")
def freewheel(m: Equations, r_free=SHARE,
              g_free=P(200.0, "1/s", positive=True, grid=(0.3,), doc="how fast it grips"), b_free=DRAG,
              side=P(1.0, "", vary=False, lower=-1.0, upper=1.0, grid=(1.0, -1.0), doc="direction it drives, fixed")):
    """Load behind a freewheel (one-way clutch), driven in one direction and free to overrun. Zhu & Parker, JSV, 2005.

    Seen as a motor that stops sooner than its inertia while running up allows. The direction that suits is taken,
    unless given. While it grips its torque is J·r·(1−r)·g·Δω."""
    grip = m.symbols["J"] * r_free * (1 - r_free) * g_free
    _driven_load(m, r_free, b_free, lambda slip: side * grip * ca.fmax(side * slip, 0), "free")


@effect(balance="torque")
def measured_load(m: Equations, k_l=P(1.0, "", null=0.0, doc="of the recorded torque that acts; 1: all of it")):
    """Recorded load torque, against positive speed. Isermann, Identification of Dynamic Systems, 2011."""
    m.torque -= k_l * m.input("tau_load")
