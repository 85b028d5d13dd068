"""Motors of clearly different sizes, in SI units."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Motor:
    """A brushed DC motor: L di/dt = v − R i − K ω and J dω/dt = K i − b ω, used within v_max and i_max."""

    name: str
    R: float  # Ω
    L: float  # H
    K: float  # N·m/A = V·s/rad
    b: float  # N·m·s/rad
    J: float  # kg·m²
    v_max: float  # V
    i_max: float  # A

    @property
    def no_load_speed(self) -> float:
        """Speed in rad/s at which the back-EMF equals v_max."""
        return self.v_max / self.K


MOTORS: dict[str, Motor] = {
    m.name: m
    for m in (
        Motor("micro", R=10.4, L=1.05e-3, K=8.3e-3, b=9.0e-8, J=1.1e-7, v_max=12.0, i_max=1.0),  # coreless
        Motor("lab", R=1.38, L=1.72e-3, K=0.0462, b=6.5e-5, J=2.35e-5, v_max=12.0, i_max=8.0),  # bench
        Motor("servo", R=3.2, L=1.1e-3, K=0.35, b=4.0e-3, J=1.8e-3, v_max=7.4, i_max=2.4),  # behind its gears
        Motor("wheel", R=0.81, L=0.55e-3, K=0.061, b=1.9e-4, J=3.1e-4, v_max=24.0, i_max=30.0),  # cart
        Motor("big", R=0.32, L=0.9e-3, K=0.17, b=8.0e-4, J=1.6e-3, v_max=48.0, i_max=150.0),  # machine axis
    )
}
