"""A second blind battery, written down before any run of the tool, when the library had 36 effects.

`acc`, `alts` and `whole` name what these records cannot distinguish from the truth, by reasoning on the equations.
In 'outside' cases `acc` is a part that does act beside the foreign shape (the mean of a friction that varies).
"""

from __future__ import annotations

from battery.blind.build import Battery

B = Battery()
S, D, N, X = B.single, B.pair, B.none, B.outside
A = {"ch": "iwt", "cpr": 16000, "zero": False, "tacho": True}  # an absolute encoder on the output, a tacho

# One effect of the library
S("coulomb_pump", "pump", {"coulomb": .045}, "telegraph pulses", "ramps")
S("coulomb_belt_counts", "belt", {"coulomb": .06}, "steps mprbs", "sweepdown", ch="iwt", cpr=1e5, adc=11)
S("coulomb_joint_theta", "joint", {"coulomb": .07}, "stopgo climb", "mprbs", ch="t", cpr=16000)
S("coulasym_winch", "winch", {"coulomb_asymmetric": (.09, .03)}, "stopgo telegraph", "ramps", **A,
  whole=[["coulomb", "constant_load"]])
S("coulasym_stage", "stage", {"coulomb_asymmetric": (.05, .09)}, "stopgo telegraph", "ramps", ch="w",
  whole=[["coulomb", "constant_load"], ["coulomb", "voltage_offset"]])
S("stribeck_arm_slow", "arm", {"stribeck": (.02, .07, .04)}, "ramps:0.35 stopgo:0.35", "stair:0.35", acc=["lugre"])
S("lugre_arm", "arm", {"lugre": (.04, .06, .05, .03)}, "posloop:0.15 ramps:0.3", "stopgo:0.3", **A, acc=["stribeck"])
S("drag_pump", "pump", {"quadratic_drag": .12}, "stair telegraph", "steps", rho=.6, drop=.03)
S("eddy_reel", "reel", {"eddy_brake": (.8, .2)}, "stair steps", "telegraph")
S("eddy_pump_counts", "pump", {"eddy_brake": (.5, .35)}, "stair telegraph", "ramps", cpr=1000, adc=11)
S("angfriction_winch", "winch", {"angular_friction": (.06, .7, .4)}, "ramps:0.5 steps:0.5", "telegraph:0.6",
  **A, h_=2.5e-5)
S("angfriction_arm", "arm", {"angular_friction": (.07, .5, 2.0)}, "telegraph:0.6 stopgo:0.6", "ramps:0.5", **A, rho=.5)
S("viscasym_belt", "belt", {"viscous_asymmetric": .05}, "steps speedloop", "ramps", hum=.02)
S("loadfric_winch", "winch", {"load_friction": .18}, "mprbs stopgo", "telegraph", rho=.7)
S("gear_winch_J_known", "winch", {"gear_efficiency": (.8, 1.7)}, "mprbs stopgo", "telegraph", fixed=["J"])
S("gear_arm_J_free", "arm", {"gear_efficiency": (.75, 1.6)}, "mprbs stopgo", "steps", acc=["load_friction"])
S("load_belt", "belt", {"constant_load": .06}, "telegraph steps", "sweepdown", ch="iwt", cpr=1e5)
S("load_joint_w", "joint", {"constant_load": .05}, "steps mprbs", "climb", ch="w", acc=["voltage_offset"])
S("gravity_arm", "arm", {"gravity": (.07, 0.0)}, "posloop:0.3 mprbs:0.5", "telegraph:0.5", **A, acc=["cogging"])
S("spring_arm", "arm", {"spring": (.03, .6)}, "mprbs:0.5 steps:0.4", "ramps:0.5", **A)
S("spring_joint", "joint", {"spring": (.02, 0.0)}, "telegraph:0.5 steps:0.4", "climb:0.5", ch="wt", cpr=8000,
  tacho=True)
S("cogging_winch", "winch", {"cogging": (.05, 12, .5)}, "ramps:0.35 stair:0.3", "telegraph:0.4", **A)
S("cogging_belt", "belt", {"cogging": (.05, 157.08, 1.0)}, "ramps:0.35 steps:0.4", "posloop:0.4", ch="iwt", cpr=1e5,
  T=1.2)
S("ripple_arm", "arm", {"torque_ripple": (.2, 6, .4)}, "mprbs:0.6 steps:0.6", "stopgo:0.6", **A)
S("compliance_reel", "reel", {"compliance": (.55, 50.0, .03)}, "telegraph prbs", "mprbs")
S("backlash_winch", "winch", {"backlash": (.5, .06, 300.0, .15)}, "steps:0.5 prbs:0.6", "mprbs:0.6", **A, h_=5e-5)
S("brush_micro", "micro", {"brush_drop": .1}, "stopgo mprbs", "ramps")
S("heating_pump", "pump", {"winding_heating": (70, 4.0)}, "prbs mprbs", "steps", T=8.0, dt=4e-3)
S("magnet_reel", "reel", {"magnet_heating": (70, 5.0)}, "prbs mprbs", "steps", T=16.0, dt=.01)
S("magnet_pump_counts", "pump", {"magnet_heating": (80, 3.0)}, "mprbs steps", "prbs", T=8.0, dt=4e-3, cpr=500, adc=11)
S("indsat_winch", "winch", {"inductance_saturation": .4}, "prbs steps", "mprbs", dt=5e-4, T=1.0, ni=.005, h_=5e-5)
S("magsat_pump", "pump", {"magnetic_saturation": 1.8}, "prbs mprbs", "telegraph")
S("deadband_reel", "reel", {"driver_dead_band": .09}, "ramps:0.7 telegraph:0.6", "multisine:0.8")
S("deadband_belt_jump", "belt", {"driver_dead_band": (.14, "jump")}, "telegraph:0.6 multisine:0.8", "ramps:0.8")
S("coast_pump", "pump", {"driver_coast": 1.05}, "stopgo pulses", "stopgo")
S("coast_winch", "winch", {"driver_coast": 1.1}, "pulses stopgo", "telegraph", rho=.5)
S("limit_reel", "reel", {"driver_current_limit": .7}, "prbs mprbs", "steps", h_=5e-5)
S("limit_belt", "belt", {"driver_current_limit": .6}, "telegraph steps", "mprbs", hum=.01)
S("sag_pump", "pump", {"supply_sag": .35}, "steps telegraph", "prbs", h_=5e-5)
S("sag_winch_counts", "winch", {"supply_sag": .25}, "stair prbs", "telegraph", ch="iw", cpr=20000, adc=11)
S("supply_logged_pump", "pump", {"measured_supply": 1}, "steps telegraph", "ramps", bus="wanders", log="supply")
S("voffset_micro", "micro", {"voltage_offset": .03}, "mprbs steps", "climb", cpr=1024, adc=12)
S("speedlag_belt", "belt", {"speed_lag": 5e-3}, "steps telegraph", "mprbs")
S("speeddelay_pump", "pump", {"speed_delay": 8e-3}, "mprbs telegraph", "steps")
S("average_pump_counts", "pump", {"speed_average": .02}, "telegraph steps", "mprbs", cpr=500, window=20, adc=12)
S("average_reel", "reel", {"speed_average": .08}, "prbs telegraph", "mprbs")
S("speedgain_winch", "winch", {"speed_gain": 1.07}, "steps telegraph", "ramps", ch="iwt", cpr=16000, tacho=True)
S("speedoffset_arm", "arm", {"speed_offset": .025}, "telegraph stopgo", "ramps", ch="iwt", cpr=16000, tacho=True)
S("currentlag_belt", "belt", {"current_lag": 3e-3}, "prbs telegraph", "steps")
S("currentoffset_pump", "pump", {"current_offset": .04}, "steps mprbs", "telegraph",
  whole=[["constant_load", "voltage_offset"]])
S("currentgain_winch_R_known", "winch", {"current_gain": 1.12}, "telegraph steps", "mprbs", fixed=["R"])
S("supplyside_pump", "pump", {"supply_side_current": ("signed", 1.0)}, "steps telegraph", "mprbs")
S("supplyside_winch_no_sign", "winch", {"supply_side_current": ("unsigned", 1.0)}, "telegraph stair", "steps", rho=.5)

# Two
D("coulomb_coast", "pump", {"coulomb": .05, "driver_coast": 1.05}, "stopgo telegraph", "pulses")
D("coulomb_sag", "winch", {"coulomb": .05, "supply_sag": .3}, "stopgo prbs", "telegraph")
D("spring_coulomb", "arm", {"spring": (.03, 0.0), "coulomb": .04}, "mprbs:0.5 steps:0.5", "ramps:0.5", **A)
D("eddy_coulomb", "reel", {"eddy_brake": (.8, .25), "coulomb": .03}, "stair stopgo", "telegraph")
D("limit_coulomb", "reel", {"driver_current_limit": .65, "coulomb": .05}, "prbs stopgo", "telegraph", h_=5e-5)
D("average_coulomb", "pump", {"speed_average": .02, "coulomb": .05}, "telegraph stopgo", "mprbs", cpr=500, window=20)
D("speedoffset_coulomb", "reel", {"speed_offset": .03, "coulomb": .05}, "stopgo pulses", "telegraph")
D("magnet_coulomb", "reel", {"magnet_heating": (80, 5.0), "coulomb": .04}, "prbs stopgo", "mprbs", T=16.0, dt=.01)
D("supplyside_coulomb", "winch", {"supply_side_current": ("signed", 1.0), "coulomb": .06}, "steps telegraph", "stopgo")
D("angfriction_gravity", "arm", {"angular_friction": (.06, .6, 1.0), "gravity": (.05, 0.0)}, "telegraph:0.6 ramps:0.5",
  "mprbs:0.6", **A, alts={"gravity": ["cogging"]})
D("loadfric_speedlag", "winch", {"load_friction": .2, "speed_lag": .01}, "mprbs stopgo", "telegraph")
D("brush_drag", "pump", {"brush_drop": .07, "quadratic_drag": .12}, "stair telegraph", "mprbs", adc=12)
D("stribeck_cogging", "winch", {"stribeck": (.02, .06, .05), "cogging": (.05, 9, .2)}, "ramps:0.3 stopgo:0.35",
  "stair:0.35", **A, alts={"stribeck": ["lugre"]})
D("viscasym_currentoffset", "belt", {"viscous_asymmetric": .05, "current_offset": .04}, "steps telegraph", "ramps",
  whole=[["viscous_asymmetric", "constant_load", "voltage_offset"]])
D("gravity_deadband", "arm", {"gravity": (.06, .4), "driver_dead_band": .06}, "telegraph:0.5 mprbs:0.5", "ramps:0.6",
  **A, alts={"gravity": ["cogging"]})
D("heating_drag", "pump", {"winding_heating": (80, 4.0), "quadratic_drag": .12}, "prbs stair", "mprbs", T=8.0, dt=4e-3)
D("backlash_load", "winch", {"backlash": (.5, .07, 300.0, .15), "constant_load": .05}, "prbs:0.6 steps:0.5",
  "mprbs:0.6",
  h_=5e-5)
D("ripple_delay", "joint", {"torque_ripple": (.2, 5, .3), "speed_delay": .012}, "mprbs:0.5 steps:0.5", "telegraph:0.5",
  ch="wt", cpr=16000, tacho=True)
D("cogging_load", "belt", {"cogging": (.05, 104.72, .4), "constant_load": .05}, "ramps:0.4 steps:0.4", "telegraph:0.4",
  ch="iwt", cpr=1e5, T=1.2)
D("currentgain_coulomb", "winch", {"current_gain": 1.15, "coulomb": .05}, "telegraph stopgo", "mprbs", fixed=["R"])
D("magsat_speedlag", "pump", {"magnetic_saturation": 1.6, "speed_lag": 8e-3}, "prbs mprbs", "telegraph")

# Nothing
N("white_pump", "pump", "telegraph mprbs", "ramps")
N("quiet_winch", "winch", "steps telegraph", "mprbs", ni=.002, nw=.0015)
N("coloured_reel", "reel", "telegraph steps", "stair", rho=.9, ni=.02, nw=.012)
N("coloured_arm", "arm", "stopgo mprbs", "ramps", rho=.96, ni=.03, nw=.02)
N("counts_micro", "micro", "steps telegraph", "mprbs", cpr=128, adc=9)
N("counts_belt", "belt", "mprbs steps", "speedloop", ch="iwt", cpr=4e4, adc=9)
N("counts_backward_pump", "pump", "telegraph steps", "stopgo", cpr=400, adc=10, backward=True,
  acc=["speed_delay", "speed_lag", "speed_average"])
N("pwm_pump", "pump", "steps telegraph", "ramps", pwm=10, cpr=4000, adc=11)
N("pwm_sag_hum_winch", "winch", "mprbs steps", "stair", pwm=8, bus_sag=.1, hum=.02)
N("hum_reel", "reel", "telegraph steps", "ramps", hum=.07)
N("hum_coloured_micro", "micro", "mprbs climb", "steps", hum=.05, rho=.8)
N("drops_winch", "winch", "telegraph stopgo", "mprbs", drop=.12, burst=True)
N("spikes_belt", "belt", "mprbs telegraph", "steps", spikes=.004)
N("one_glitch_pump", "pump", "steps telegraph", "mprbs", glitch=True)
N("speedloop_reel", "reel", "speedloop speedloop", "speedloop", cpr=2048, adc=12)
N("posloop_arm", "arm", "posloop posloop", "speedloop", ch="iwt", cpr=16000, adc=12)
N("zeroed_arm", "arm", "telegraph stopgo", "mprbs", ch="iwt", cpr=8000, th0="random")
N("supply_logged_pump", "pump", "telegraph steps", "ramps", log="supply")
N("load_cell_noise_winch", "winch", "telegraph steps", "mprbs", log="load temp")
N("short_belt", "belt", "telegraph", "mprbs", T=.15)
N("rolling_uneven_reel", "reel", "telegraph mprbs", "steps", pre=1.0, uneven=True)
N("joint_w", "joint", "steps climb", "telegraph", ch="w", rho=.6)

# What the library does not have
X("self_warm", "arm", {"x_self_warm": (1.2, 2.0)}, "mprbs stopgo", "telegraph",
  "bearing friction that falls as the motor's"
  " loss warms it", b_mul=4.0, T=8.0, dt=4e-3)
X("friction_sets_in", "winch", {"x_friction_sets_in": (.02, 4.0, 1.5)}, "telegraph stopgo", "mprbs",
  "dry friction that grows with the time since the start (its first part is coulomb)", T=4.0, acc=["coulomb"])
X("duty_ripple", "winch", {"x_ripple_duty": (.15, 8)}, "steps:0.6 telegraph:0.6", "mprbs:0.6",
  "voltage that ripples with the commutation", **A)
X("crank_once", "arm", {"x_crank_once": .35}, "mprbs:0.6 steps:0.6", "telegraph:0.6",
  "inertia that depends on the angle", **A)
X("tacho_curve", "winch", {"x_tacho_curve": .12}, "stair telegraph", "steps", "tacho that reads less when fast",
  ch="iwt",
  cpr=16000, tacho=True)
X("tacho_dead", "reel", {"x_tacho_dead": .05}, "ramps telegraph", "stair", "tacho that reads nothing when slow")
X("torque_play", "winch", {"x_torque_play": .06}, "mprbs stopgo", "telegraph",
  "torque that follows the current with play")
X("current_curve", "pump", {"x_current_gain": 1.0}, "prbs telegraph", "steps", "current sensor that saturates")
X("slip_clutch", "reel", {"x_slip_clutch": (.5, .2, 2e-3)}, "prbs telegraph", "mprbs",
  "load behind a clutch that slips")
X("late_when_small", "belt", {"x_late_when_small": .012}, "telegraph mprbs", "steps",
  "voltage that acts later when small")
X("oneway_fan", "pump", {"x_oneway_fan": .25}, "stair telegraph", "steps", "drag of a fan that takes air one way only"
  " (half of it is quadratic_drag)", acc=["quadratic_drag"])
X("end_stop", "arm", {"x_endstop": (1.2, .25)}, "steps:0.5 mprbs:0.6", "telegraph:0.6", "elastic stop at an angle", **A)
X("spring_cubic", "arm", {"x_spring_cubic": 4e-3}, "mprbs:0.6 steps:0.5", "ramps:0.5", "spring that stiffens", **A)
X("load_pulses", "winch", {"x_load_time": (.08, "pulses", .6)}, "steps telegraph", "mprbs",
  "load in pulses of time (their mean is constant_load)", acc=["constant_load"])
X("flux_of_speed", "pump", {"x_flux_speed": .25}, "stair telegraph", "mprbs", "flux that falls with the speed")
X("detent", "winch", {"x_detent": (.1, 4, .3)}, "ramps:0.4 steps:0.5", "telegraph:0.5",
  "notches, narrow over the angle (their fundamental is cogging)", **A, acc=["cogging"])
X("driver_soft", "belt", {"x_driver_soft": .8}, "stair telegraph", "mprbs", "amplifier that saturates")
X("driver_uneven", "reel", {"x_driver_uneven": .15}, "telegraph steps", "ramps",
  "bridge with another gain per direction")
X("slew", "pump", {"x_slew": 60.0}, "telegraph steps", "mprbs", "voltage that rises only so fast")
X("angle_curve", "arm", {"x_angle_curve": .15}, "telegraph:0.6 ramps:0.6", "mprbs:0.6", "angle sensor out of centre",
  ch="it",
  zero=False, cpr=16000)
X("derate", "reel", {"x_derate": (.35, 3.0)}, "prbs mprbs", "steps", "driver that gives less when warm", T=14.0, dt=.01)
X("mass_drop", "winch", {"x_mass_drop": (.6, 1.5)}, "telegraph mprbs", "steps", "inertia that drops at a time")
