"""A third blind battery with a plant of its own, written down before any run of the tool on it.

`acc`, `alts` and `whole` name what these records cannot distinguish from the truth, by reasoning on the equations.
In 'outside' cases `acc` is a part that does act beside the foreign shape, or the nearest of the library by its physics.
"""

from __future__ import annotations

from battery.blind import third_plant
from battery.blind.build import Battery

B = Battery(third_plant)
S, D, N, X = B.single, B.pair, B.none, B.outside
ABS = {"ch": "iwt", "cpr": 20000, "anywhere": True}  # an absolute encoder on the shaft, and a tacho

# One effect of the library each
S("brush_drop", "spindle", {"brush_drop": .05}, "levels slow", "steps")
S("winding_heating", "traction", {"winding_heating": (.5, 6.0)}, "steps levels", "stair", T=14.0, dt=5e-3, h=5e-4)
S("magnet_heating", "traction", {"magnet_heating": (.2, 5.0)}, "steps levels", "stair", T=14.0, dt=5e-3, h=5e-4)
S("inductance_saturation", "crane", {"inductance_saturation": .3}, "levels steps", "onoff", dt=2e-3, T=5.0)
S("magnetic_saturation", "wheel", {"magnetic_saturation": .8}, "steps msine", "levels")
S("driver_dead_band", "blower", {"driver_dead_band": .07}, "msine steps", "tri")
S("driver_coast", "can", {"driver_coast": ()}, "onoff onoff", "levels onoff")
S("driver_current_limit", "crane", {"driver_current_limit": .4}, "steps levels", "stair")
S("supply_sag", "can", {"supply_sag": .2}, "levels steps", "stair", rho=.7)
S("voltage_offset", "wheel", {"voltage_offset": .035}, "msine steps", "tri", bits=11)
S("coulomb", "geared", {"coulomb": .06}, "ploop:0.3 steps", "tri:0.5", **ABS)
S("coulomb_asymmetric", "spindle", {"coulomb_asymmetric": (.03, .07)}, "levels tri", "steps",
  whole=[["coulomb", "constant_load"]])
S("stribeck", "geared", {"stribeck": (.03, .08, .05)}, "tri:0.3 onoff:0.3", "slow:0.3", ch="iwt", cpr=20000,
  acc=["lugre"])
S("lugre", "pivot", {"lugre": (.05, .08, .03, .4)}, "tri:0.15 msine:0.2", "steps:0.18", ch="wt", cpr=20000)
S("angular_friction", "wheel", {"angular_friction": (.08, .6, 1, .8)}, "tri:0.5 steps:0.5", "slow:0.5", **ABS)
S("viscous_asymmetric", "blower", {"viscous_asymmetric": .06}, "steps msine", "tri", drop=.05)
S("quadratic_drag", "blower", {"quadratic_drag": .3}, "stair levels", "chirp", hum=.01)
S("eddy_brake", "can", {"eddy_brake": (.08, .25)}, "stair levels", "tri")
S("load_friction", "wheel", {"load_friction": .15}, "steps levels", "msine", acc=["gear_efficiency"])
S("gear_efficiency", "geared", {"gear_efficiency": (.75, 1.1)}, "steps msine", "levels", fixed=["J"])
S("constant_load", "crane", {"constant_load": .08}, "steps msine", "stair")
S("gravity", "geared", {"gravity": (.07, .5)}, "msine steps", "tri", **ABS)
S("spring", "wheel", {"spring": (.12, .3)}, "msine onoff", "steps", ch="it", cpr=8000)
S("cogging", "wheel", {"cogging": (.05, 9, 1.1)}, "slow:0.25 tri:0.4", "steps:0.35", **ABS)
S("torque_ripple", "geared", {"torque_ripple": (.25, 5, .4)}, "steps levels", "tri", **ABS)
S("compliance", "spindle", {"compliance": (.6, 75.0, .03)}, "steps levels", "chirp")
S("backlash", "geared", {"backlash": (.5, .08, 90.0, .15)}, "msine levels", "steps", ch="iwt", cpr=20000)
S("speed_lag", "can", {"speed_lag": 9e-3}, "levels steps", "chirp")
S("speed_delay", "coreless", {"speed_delay": 7e-3}, "levels steps", "chirp")
S("speed_average", "spindle", {"speed_average": 24e-3}, "steps levels", "msine")
S("speed_gain", "wheel", {"speed_gain": 1.06}, "levels steps", "tri", ch="iwt", cpr=4000)
S("speed_offset", "can", {"speed_offset": .03}, "steps levels", "tri")
S("current_lag", "crane", {"current_lag": .025}, "levels steps", "onoff")
S("current_offset", "coreless", {"current_offset": .025}, "steps msine", "stair")
S("current_gain", "spindle", {"current_gain": 1.12}, "levels steps", "tri", fixed=["R"])
S("supply_side_current", "blower", {"supply_side_current": "signed"}, "steps levels", "msine")

# Two effects
D("coulomb_drag", "blower", {"coulomb": .04, "quadratic_drag": .12}, "stair steps", "levels")
D("coulomb_cogging", "wheel", {"coulomb": .05, "cogging": (.05, 11, .3)}, "slow:0.3 tri:0.5", "steps:0.45", **ABS)
D("coulomb_gravity", "geared", {"coulomb": .05, "gravity": (.08, 1.0)}, "steps ploop:0.4", "tri", **ABS)
D("coulomb_compliance", "spindle", {"coulomb": .04, "compliance": (.6, 80.0, .04)}, "steps levels", "tri")
D("dead_band_coulomb", "wheel", {"driver_dead_band": .06, "coulomb": .05}, "msine levels", "steps:0.8")
D("brush_coulomb", "can", {"brush_drop": .05, "coulomb": .03}, "steps levels", "tri")
D("sag_drag", "blower", {"supply_sag": .2, "quadratic_drag": .12}, "stair levels", "steps", rho=.5)
D("heating_coulomb", "traction", {"winding_heating": (1.2, 4.0), "coulomb": .03}, "steps levels", "stair", T=14.0,
  dt=5e-3, h=5e-4)
D("lag_coulomb", "spindle", {"speed_lag": 8e-3, "coulomb": .04}, "levels steps", "msine")
D("current_offset_lag", "crane", {"current_offset": .03, "speed_lag": .08}, "levels steps", "chirp")
D("load_coulomb", "crane", {"constant_load": .06, "coulomb": .04}, "levels steps", "tri",
  whole=[["coulomb_asymmetric"]])
D("spring_coulomb", "wheel", {"spring": (.12, 0.0), "coulomb": .04}, "msine onoff", "levels", ch="it", cpr=16000)
D("backlash_coulomb", "geared", {"backlash": (.5, .08, 90.0, .2), "coulomb": .03}, "levels msine", "steps", ch="iwt",
  cpr=20000)
D("ripple_coulomb", "geared", {"torque_ripple": (.2, 4, 1.3), "coulomb": .05}, "levels steps", "slow", **ABS)
D("saturation_coulomb", "crane", {"magnetic_saturation": .8, "coulomb": .03}, "steps levels", "onoff")
D("limit_drag", "traction", {"driver_current_limit": .4, "quadratic_drag": .08}, "steps stair", "levels")
D("inductance_brush", "crane", {"inductance_saturation": .3, "brush_drop": .03}, "levels steps", "msine", dt=2e-3,
  T=5.0)
D("offset_eddy", "can", {"voltage_offset": .03, "eddy_brake": (.07, .25)}, "stair levels", "steps")
D("coast_coulomb", "wheel", {"driver_coast": (), "coulomb": .03}, "onoff onoff", "levels onoff")
D("gravity_stribeck", "pivot", {"gravity": (.06, 0.0), "stribeck": (.03, .06, .03)}, "tri:0.4 steps:0.4", "msine:0.4",
  ch="wt", cpr=20000)

# Nothing but the bench
N("white_can", "can", "levels steps", "tri")
N("white_crane", "crane", "up msine", "stair")
N("coloured_spindle", "spindle", "steps chirp", "levels", rho=.9)
N("coloured_blower", "blower", "msine tri", "steps", rho=.97, nw=.01)
N("counts_wheel", "wheel", "levels tri", "steps", counts=16000)
N("counts_geared_coarse", "geared", "steps msine", "levels", counts=3000)
N("counts_backward", "spindle", "steps levels", "stair", counts=4000, central=False,
  acc=["speed_delay", "speed_average", "speed_lag"])
N("zeroed_slide", "slide", "levels steps", "tri", ch="it", cpr=50000, zero=True)
N("omega_only", "can", "levels stair", "steps", ch="w")
N("theta_only", "geared", "steps levels", "msine", ch="t", cpr=8000)
N("pwm_spindle", "spindle", "steps levels", "tri", pwm=16)
N("hum", "blower", "steps tri", "levels", hum=.03)
N("dropped", "can", "msine steps", "levels", drop=.15)
N("loop_wheel", "wheel", "sloop sloop", "ploop:0.5", ch="iwt", cpr=8000)
N("loop_pivot_zeroed", "pivot", "sloop ploop:0.4", "sloop", ch="wt", cpr=20000, zero=True)
N("loop_can_counts", "can", "sloop sloop", "levels", counts=2000)
N("short", "coreless", "steps levels", "msine", T=.12)
N("uneven", "crane", "levels steps", "tri", uneven=True)
N("converter_linear_hold", "traction", "msine chirp", "growing", bits=8, hold="linear")

# What the library lacks
X("dead_pole", "wheel", {"x_dead_pole": (.25, 1.0, 2.6)}, "steps levels", "tri", "a magnet weaker over a sector", **ABS,
  acc=["torque_ripple"])
X("brush_lift", "can", {"x_brush_lift": 1.5}, "levels steps", "stair", "contact resistance that rises with the speed")
X("brush_shift", "crane", {"x_brush_shift": .2}, "steps levels", "msine", "a field that the current weakens one way")
X("iron_loop", "crane", {"x_iron_loop": 1.5}, "levels steps", "onoff", "eddy currents in the core", dt=2e-3, T=5.0)
X("knee", "wheel", {"x_knee": (.3, .3)}, "steps levels", "onoff", "torque that bends at a current",
  acc=["magnetic_saturation"])
X("gain_kink", "spindle", {"x_gain_kink": (.5, .6)}, "msine levels", "tri", "amplifier of less gain above a level")
X("min_pulse", "blower", {"x_min_pulse": (.15, .85)}, "msine levels", "tri", "short pulses left out, short gaps filled",
  acc=["driver_dead_band"])
X("brown_out", "spindle", {"x_brown_out": (.5, .62, .72)}, "steps levels", "stair", "a supply that drops for a moment")
X("pumped_bus", "traction", {"x_pumped_bus": 3.0}, "up levels", "up", "a bus that braking pumps up",
  acc=["supply_sag"])
X("battery", "blower", {"x_battery": .25}, "steps levels", "up", "a battery that weakens with its charge")
X("filter", "spindle", {"x_filter": (150.0, .12)}, "steps levels", "onoff", "a resonant filter behind the bridge")
X("drive_lag", "table", {"x_drive_lag": .03}, "levels steps", "chirp", "a current loop that takes its time", ch="w",
  acc=["speed_lag", "speed_delay", "speed_average"])
X("head_room", "pivot", {"x_head_room": .6}, "steps levels", "stair", "a drive short of voltage at speed", ch="wt",
  cpr=8000, acc=["driver_current_limit"])
X("rub", "wheel", {"x_rub": (.12, .5, 2.2)}, "tri:0.6 levels", "steps", "a rub over a sector of the turn", **ABS,
  acc=["coulomb", "angular_friction"])
X("worn_rail", "slide", {"x_worn_rail": (.02, .08)}, "msine steps", "tri", "friction that grows towards the ends",
  ch="iwt", cpr=1e5, acc=["coulomb"])
X("brake_at", "spindle", {"x_brake_at": (.08, .7)}, "steps levels", "msine", "a brake that drops in", acc=["coulomb"])
X("holding_brake", "wheel", {"x_holding_brake": .15}, "onoff onoff", "steps onoff", "a brake that falls in at zero",
  acc=["coulomb"])
X("centrifugal_brake", "can", {"x_centrifugal_brake": (.2, .5)}, "stair levels", "tri", "shoes that fly out",
  acc=["quadratic_drag"])
X("cavitation", "blower", {"x_cavitation": (.12, .35)}, "stair levels", "tri", "a screw that cavitates",
  acc=["eddy_brake", "quadratic_drag"])
X("hysteresis", "pivot", {"x_hysteresis": (.03, 1.5)}, "msine:0.3 tri:0.25", "steps:0.3", "a hysteresis brake", ch="wt",
  cpr=20000, acc=["lugre", "coulomb", "stribeck"])
X("stop", "wheel", {"x_stop": (.3, .8)}, "msine levels", "tri", "a soft stop at one end", ch="iwt", cpr=8000,
  acc=["spring"])
X("half_cam", "geared", {"x_half_cam": .07}, "tri steps", "levels", "a cam over half of the turn", **ABS,
  acc=["gravity", "constant_load", "cogging"])
X("piston", "geared", {"x_piston": .2}, "steps tri", "slow", "a compressor's stroke", **ABS,
  acc=["gravity", "constant_load", "cogging"])
X("slider_crank", "pivot", {"x_slider_crank": .6}, "levels:0.6 steps:0.6", "msine:0.7", "a mass on a crank", ch="wt",
  cpr=20000)
X("grab", "geared", {"x_grab": (.6, 1.3)}, "levels steps", "tri", "a load taken up on the way")
X("freewheel", "can", {"x_freewheel": .6}, "steps levels", "onoff", "an overrunning clutch",
  acc=["backlash", "compliance"])
X("fluid_coupling", "spindle", {"x_fluid_coupling": (.6, .02)}, "steps levels", "msine", "a fluid coupling",
  acc=["compliance"])
X("hammer", "crane", {"x_hammer": (.12, 1.7)}, "steps msine", "levels", "blows by another clock",
  acc=["constant_load"])
X("cardan", "wheel", {"x_cardan": .45}, "steps levels", "tri", "a tacho behind a bent cardan joint", **ABS)
X("one_channel", "can", {"x_one_channel": ()}, "tri levels", "steps", "a counter that knows no direction")
X("current_clip", "blower", {"x_current_clip": .45}, "steps levels", "stair", "a converter that clips the current")
X("lost_counts", "geared", {"x_lost_counts": (.5, .5)}, "levels steps", "stair", "a counter that misses edges", ch="it",
  cpr=8000)
X("loose_encoder", "slide", {"x_loose_encoder": .01}, "msine levels", "steps", "an encoder with play", ch="it", cpr=1e5,
  acc=["backlash"])
X("remanence", "traction", {"x_remanence": (.15, .2)}, "levels steps", "msine", "a Hall sensor with loops")
