"""An independent motor plant: the reality behind the records, sharing no code with the models."""

from .effects import BEYOND, LIBRARY
from .excitations import chirp, coast_down, multisine, prbs, random_steps, staircase, step, triangle, warm_up
from .loops import closed_loop, simulate_linear
from .motion import Plant, simulate
from .motors import MOTORS, Motor
from .sensors import adc, coloured, dropouts, encoder, encoder_speed, outliers, resample, uneven, white
from .sizes import SIZES

__all__ = [
    "BEYOND",
    "LIBRARY",
    "MOTORS",
    "SIZES",
    "Motor",
    "Plant",
    "adc",
    "chirp",
    "closed_loop",
    "coast_down",
    "coloured",
    "dropouts",
    "encoder",
    "encoder_speed",
    "multisine",
    "outliers",
    "prbs",
    "random_steps",
    "resample",
    "simulate",
    "simulate_linear",
    "staircase",
    "step",
    "triangle",
    "uneven",
    "warm_up",
    "white",
]
