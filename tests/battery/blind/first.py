"""A first blind battery: 120 cases, written down before any run of the tool, when the library had 24 effects.

What it has gained since is the truth of a case by `now`; that case was outside then.
"""

from __future__ import annotations

from battery.blind.build import Battery

B = Battery()
S, D, N, X = B.single, B.pair, B.none, B.outside
Q = {"cpr": 2000, "adc": 10}  # counts differenced to speed, 10-bit current
# singles
S("coulomb_lab", "lab", {"coulomb": .04}, "steps mprbs", "ramp", T=.4)
S("coulomb_coreless_counts", "coreless", {"coulomb": .03}, "stopgo steps", "mprbs", cpr=1024, adc=10)
S("coulomb_gear_voltspeed", "gear", {"coulomb": .06}, "stopgo mprbs", "ramps", ch="w", adc=10)
S("coulomb_forward", "lab", {"coulomb": .05}, "forward fwdprbs", "forward", pre=0.2,
  acc=["constant_load", "coulomb_asymmetric"], hum=.01)
S("coulomb_servo", "servo", {"coulomb": .08}, "stopgo mprbs", "chirp", ch="w", hold="linear")
S("coulomb_ramps_fly_w", "fly", {"coulomb": .03}, "ramps ramp:0.5", "stair", ch="w", T=16.0, dt=.01,
  acc=["brush_drop", "driver_dead_band"])
S("coulasym_axis", "axis", {"coulomb_asymmetric": (.09, .03)}, "stopgo steps", "ramps", ch="iwt", cpr=5e4,
  whole=[["coulomb", "constant_load"]])
S("coulasym_emps", "emps", {"coulomb_asymmetric": (.05, .10)}, "stopgo steps", "posloop", ch="w",
  whole=[["coulomb", "constant_load"], ["coulomb", "voltage_offset"]])
S("stribeck_gear_slow", "gear", {"stribeck": (.02, .06, .04)}, "ramps:0.4 stopgo:0.4", "stair:0.4", ch="iw",
  acc=["lugre"])
S("stribeck_lab_pos", "lab", {"stribeck": (.02, .07, .03)}, "posloop ramps:0.3", "posloop", ch="iwt", cpr=4000,
  acc=["lugre"], h_=5e-5)
S("stribeck_emps", "emps", {"stribeck": (.025, .065, .06)}, "ramps:0.4 stopgo:0.4", "mprbs:0.4", ch="wt", cpr=4e4,
  acc=["lugre"])
S("drag_lab", "lab", {"quadratic_drag": .15}, "stair steps", "forward", spikes=.001, burst=True)
S("drag_fly_counts", "fly", {"quadratic_drag": .06}, "steps stair", "ramp", cpr=1024, adc=10, T=12.0)
S("load_axis", "axis", {"constant_load": .05}, "steps mprbs", "ramps", ch="iwt", cpr=4e4)
S("load_servo", "servo", {"constant_load": .04}, "steps mprbs", "speedloop", ch="w", acc=["voltage_offset"])
S("gravity_gear", "gear", {"gravity": (.05, 0.0)}, "posloop:0.3 steps:0.4", "mprbs:0.5", ch="iwt", cpr=8000,
  acc=["cogging"], zero=False)
S("gravity_gear_theta", "gear", {"gravity": (.08, .6)}, "ramps:0.5 posloop:0.3", "stair:0.5", ch="it", cpr=8000,
  acc=["cogging"], zero=False)
S("gravity_servo", "servo", {"gravity": (.12, 0.0)}, "posloop:0.2 mprbs:0.5", "ramps:0.6", ch="wt",
  acc=["cogging"], drop=.02)
S("cogging_gear", "gear", {"cogging": (.04, 8, .5)}, "ramps:0.5 stair:0.4", "mprbs:0.5", ch="iwt", cpr=20000,
  zero=False, ni=.02)
S("cogging_lab_zeroed", "lab", {"cogging": (.03, 6, 0.0)}, "ramps:0.3 stopgo:0.3", "stair:0.3", ch="iwt", cpr=8000,
  angle=True, acc=[])
S("cogging_axis", "axis", {"cogging": (.04, 209.4, .3)}, "ramps:0.4 steps:0.4", "posloop:0.4", ch="wt", cpr=1e5,
  zero=False, acc=["torque_ripple"])
S("ripple_gear", "gear", {"torque_ripple": (.25, 6, .4)}, "mprbs:0.6 steps:0.6", "stopgo:0.6", ch="iwt", cpr=20000,
  zero=False)
S("ripple_servo", "servo", {"torque_ripple": (.15, 4, 1.0)}, "mprbs:0.5 steps:0.4", "chirp:0.6", ch="wt")
S("loadfric_gear", "gear", {"load_friction": .15}, "steps mprbs", "stopgo", ch="iw", rho=.7)
S("loadfric_axis", "axis", {"load_friction": .2}, "mprbs stopgo", "chirp", ch="iwt", cpr=2e5)
S("viscasym_lab", "lab", {"viscous_asymmetric": .03}, "steps speedloop", "ramp", hum=.02, T=.7)
S("viscasym_axis_q", "axis", {"viscous_asymmetric": .06}, "stopgo ramps", "steps", ch="iwt", cpr=5e4, adc=10)
S("lugre_gear", "gear", {"lugre": (.04, .06, .05, .03)}, "posloop:0.1 ramps:0.3", "stopgo:0.3", ch="iwt", cpr=40000,
  acc=["stribeck"])
S("lugre_emps", "emps", {"lugre": (.03, .03, .1, 2e-3)}, "posloop:0.2 stopgo:0.4", "ramps:0.3", ch="wt", cpr=5e4,
  acc=["coulomb", "stribeck"])
S("brush_coreless", "coreless", {"brush_drop": .09}, "stopgo mprbs", "ramps")
S("brush_lab_q", "lab", {"brush_drop": .06}, "steps stair", "chirp", pwm=8, bus_sag=.1, **Q)
S("heating_fly", "fly", {"winding_heating": (70, 8.0)}, "mprbs prbs", "steps", T=20.0, dt=.01, uneven=True)
S("heating_lab", "lab", {"winding_heating": (60, 3.0)}, "prbs mprbs", "steps", T=6.0, dt=2e-3, cpr=2000)
S("indsat_lab", "lab", {"inductance_saturation": .5}, "prbs mprbs", "steps", dt=3e-4, T=.5, h_=3e-5, ni=.005)
S("indsat_axis", "axis", {"inductance_saturation": .35}, "prbs steps", "mprbs", dt=5e-4, T=1.0, ni=.005, h_=2.5e-5)
S("magsat_fly", "fly", {"magnetic_saturation": 1.7}, "prbs mprbs", "steps", T=10.0, drop=.03)
S("magsat_lab_counts", "lab", {"magnetic_saturation": 2.2}, "prbs steps", "mprbs", cpr=2000)
S("deadband_lab", "lab", {"driver_dead_band": .10}, "ramps:0.7 chirp:0.8", "multisine", hold="linear",
  acc=["brush_drop"])
S("deadband_coreless_jump", "coreless", {"driver_dead_band": (.15, "jump")}, "ramps:0.8 multisine:0.8", "stair:0.8",
  cpr=1024)
S("deadband_servo", "servo", {"driver_dead_band": .06}, "ramps:0.7 mprbs:0.7", "multisine", ch="w", acc=["coulomb"])
S("voffset_lab", "lab", {"voltage_offset": .03}, "speedloop steps", "chirp", cpr=2000, adc=11)
S("voffset_gear_w", "gear", {"voltage_offset": .05}, "mprbs stopgo", "ramps", ch="w", acc=["constant_load"])
S("speedlag_lab", "lab", {"speed_lag": 6e-3}, "steps mprbs", "chirp", acc=[])
S("speedlag_coreless_small", "coreless", {"speed_lag": 1.5e-3}, "prbs mprbs", "steps", nw=.003, acc=["speed_delay"])
S("speeddelay_lab", "lab", {"speed_delay": 4e-3}, "mprbs steps", "multisine", acc=[])
S("speeddelay_axis", "axis", {"speed_delay": 2e-3}, "prbs steps", "speedloop", nw=.004, acc=["speed_lag"])
S("speedgain_gear", "gear", {"speed_gain": 1.08}, "steps mprbs", "ramps", ch="iwt", cpr=8000, tacho=True)
S("currentlag_lab", "lab", {"current_lag": 4e-3}, "prbs mprbs", "steps")
S("currentlag_axis", "axis", {"current_lag": 5e-3}, "steps stopgo", "mprbs", ch="iw", hum=.01)
S("currentoffset_coreless", "coreless", {"current_offset": .03}, "steps mprbs", "ramp", whole=[["constant_load",
  "voltage_offset"]])
S("compliance_fly", "fly", {"compliance": (.6, 45.0, .03)}, "steps speedloop prbs", "mprbs", T=8.0, dt=4e-3)
S("compliance_gear_w", "gear", {"compliance": (.5, 90.0, .04)}, "mprbs stopgo", "steps", ch="w")
S("backlash_gear", "gear", {"backlash": (.5, .08, 300.0, .15)}, "steps:0.5 prbs:0.6", "mprbs:0.6", ch="iwt", cpr=20000,
  h_=5e-5)
S("backlash_lab_pos", "lab", {"backlash": (.55, .15, 700.0, .2)}, "posloop:0.5 prbs", "mprbs", ch="iw", T=1.2, h_=5e-5)

# pairs
D("coulomb_cogging", "gear", {"coulomb": .04, "cogging": (.06, 10, 1.0)}, "ramps:0.5 stopgo:0.5", "stair:0.5", ch="iwt",
  cpr=20000, zero=False)
D("coulomb_gravity", "gear", {"coulomb": .03, "gravity": (.045, 0.0)}, "posloop:0.3 steps:0.5", "mprbs:0.6", ch="iwt",
  cpr=8000, zero=False, alts={"gravity": ["cogging"]})
D("coulomb_brush", "lab", {"coulomb": .04, "brush_drop": .07}, "stopgo mprbs", "ramps", rho=.8)
D("coulomb_speedlag", "lab", {"coulomb": .05, "speed_lag": 6e-3}, "steps mprbs", "stopgo", drop=.02)
D("coulomb_voffset", "coreless", {"coulomb": .04, "voltage_offset": .04}, "stopgo mprbs", "ramps", cpr=2048)
D("stribeck_gravity", "gear", {"stribeck": (.02, .06, .05), "gravity": (.07, .3)}, "posloop:0.3 ramps:0.4",
  "stopgo:0.4",
  ch="iwt", cpr=8000, zero=False, alts={"gravity": ["cogging"], "stribeck": ["lugre"]})
D("drag_coulomb", "fly", {"quadratic_drag": .08, "coulomb": .03}, "steps stair", "ramps", T=12.0, uneven=True)
D("loadfric_coulomb", "gear", {"load_friction": .2, "coulomb": .05}, "mprbs stopgo", "ramps", ch="iw")
D("backlash_coulomb", "gear", {"backlash": (.5, .07, 300.0, .15), "coulomb": .04}, "prbs:0.6 stopgo:0.5", "mprbs:0.6",
  ch="iw", h_=5e-5)
D("compliance_coulomb", "fly", {"compliance": (.6, 40.0, .03), "coulomb": .03}, "stopgo prbs", "mprbs", T=8.0, dt=4e-3)
D("heating_coulomb", "fly", {"winding_heating": (80, 8.0), "coulomb": .03}, "mprbs prbs", "stopgo", T=20.0, dt=.01)
D("magsat_coulomb", "lab", {"magnetic_saturation": 1.8, "coulomb": .05}, "prbs stopgo", "mprbs")
D("load_currentlag", "axis", {"constant_load": .05, "current_lag": 5e-3}, "prbs steps", "mprbs")
D("deadband_gravity", "gear", {"driver_dead_band": .05, "gravity": (.05, 0.0)}, "ramps:0.6 mprbs:0.6", "multisine:0.7",
  ch="iwt", cpr=8000, zero=False, alts={"gravity": ["cogging"], "driver_dead_band": ["brush_drop"]})
D("ripple_coulomb", "gear", {"torque_ripple": (.2, 6, 0.0), "coulomb": .05}, "mprbs:0.6 steps:0.5", "stopgo:0.6",
  ch="iwt",
  cpr=20000, zero=False)
D("speeddelay_coulomb", "axis", {"speed_delay": 5e-3, "coulomb": .07}, "steps mprbs", "stopgo", ch="iw")
D("currentoffset_coulomb", "coreless", {"current_offset": .04, "coulomb": .05}, "stopgo mprbs", "steps", cpr=2048,
  whole=[["constant_load", "voltage_offset", "coulomb"], ["coulomb_asymmetric", "voltage_offset"]])
D("indsat_brush", "axis", {"inductance_saturation": .35, "brush_drop": .06}, "prbs stopgo", "mprbs", dt=5e-4, T=1.0,
  ni=.006, h_=2.5e-5)
D("load_drag", "lab", {"constant_load": .04, "quadratic_drag": .12}, "steps stair", "mprbs", **Q)
D("coulasym_speedlag", "axis", {"coulomb_asymmetric": (.1, .04), "speed_lag": 6e-3}, "stopgo mprbs", "steps", ch="iw",
  whole=[["coulomb", "constant_load", "speed_lag"]])
D("viscasym_voffset", "lab", {"viscous_asymmetric": .05, "voltage_offset": .04}, "steps stair", "mprbs")
D("coulomb_load_servo", "servo", {"coulomb": .08, "constant_load": .06}, "stopgo mprbs", "ramps", ch="w",
  whole=[["coulomb_asymmetric"]], alts={"constant_load": ["voltage_offset"]}, spikes=.002)

# nothing hidden
N("clean_lab", "lab", "steps mprbs", "ramp", ni=.002, nw=.001)
N("clean_fly", "fly", "steps stair", "mprbs", ni=.003, nw=.002)
N("coloured_lab", "lab", "steps mprbs", "chirp", rho=.9, ni=.02, nw=.01)
N("coloured_gear_strong", "gear", "stopgo mprbs", "ramps", rho=.97, ni=.03, nw=.02)
N("counts_coreless", "coreless", "steps mprbs", "stair", cpr=256, adc=9)
N("counts_axis", "axis", "steps prbs", "speedloop", ch="iwt", cpr=5e4, adc=9)
N("counts_backward", "lab", "steps mprbs", "stopgo", cpr=500, adc=10, backward=True, acc=["speed_delay", "speed_lag"])
N("hum_lab", "lab", "steps stair", "mprbs", hum=.08)
N("hum_fly", "fly", "steps mprbs", "ramps", hum=.06, adc=10)
N("spikes_coreless", "coreless", "mprbs stopgo", "steps", spikes=.004)
N("spikes_gear_theta", "gear", "steps posloop", "mprbs", ch="iwt", spikes=.003, cpr=4000, tacho=True)
N("drops_axis", "axis", "stopgo mprbs", "ramps", drop=.08, burst=True)
N("short_lab", "lab", "mprbs", "steps", T=.2)
N("short_coreless_w", "coreless", "steps", "prbs", T=.25, ch="w")
N("speedloop_lab", "lab", "speedloop speedloop", "speedloop", cpr=2000, adc=12)
N("posloop_gear", "gear", "posloop posloop", "speedloop", ch="iwt", cpr=8000, adc=12)
N("pwm_sag_lab", "lab", "steps mprbs", "ramps", pwm=8, bus_sag=.15, cpr=4000, adc=11)
N("uneven_fly", "fly", "mprbs steps", "stair", uneven=True, drop=.02)
N("servo_w", "servo", "steps mprbs", "chirp", ch="w", rho=.6)
N("emps_theta", "emps", "posloop steps", "mprbs", ch="t", cpr=1e5)
N("long_fly", "fly", "mprbs steps stair", "ramps", T=26.0, dt=5e-3, cpr=2048, adc=10)
N("rolling_gear", "gear", "mprbs steps", "stopgo", pre=.8, rho=.5, hum=.02)

# outside
X("friction_of_angle", "gear", {"x_friction_angle": (.05, .9, .3)}, "ramps:0.6 steps:0.5", "mprbs:0.6",
  "dry friction tau_c(1 + a sin theta) (its mean is coulomb)", ch="iwt", cpr=8000, zero=False, acc=["coulomb"],
  now="angular_friction")
X("viscous_of_angle", "gear", {"x_viscous_angle": .9}, "steps:0.6 mprbs:0.6", "ramps:0.6",
  "viscous friction b(1 + a sin theta) omega",
  ch="iwt", cpr=8000, zero=False, b_mul=4.0, nw=.01)
X("eddy_brake_lab", "lab", {"x_eddy": (1.0, .15)}, "stair steps", "mprbs", "eddy-current brake c w/(1+(w/w0)^2)",
  now="eddy_brake")
X("eddy_brake_fly", "fly", {"x_eddy": (.5, .25)}, "steps stair", "ramps", "eddy-current brake c w/(1+(w/w0)^2)",
  T=12.0, now="eddy_brake")
X("coast_lab", "lab", {"x_coast": 1}, "stopgo steps", "stopgo", "driver opens its bridge at zero command (coasts)",
  ni=.03, nw=.03, now="driver_coast")
X("coast_gear_w", "gear", {"x_coast": 1}, "stopgo stopgo", "stopgo",
  "driver opens its bridge at zero command (coasts)", ch="w", nw=.02, now="driver_coast")
X("spring_gear", "gear", {"x_spring": .02}, "mprbs:0.5 steps:0.4", "ramps:0.4", "spring to ground", ch="iwt", cpr=8000,
  zero=False, now="spring")
X("commutator_gear", "gear", {"x_commutator": (.6, 1.2)}, "ramps:0.6 mprbs:0.6", "steps:0.6",
  "resistance jumps on a worn commutator segment", ch="iwt", cpr=8000, zero=False)
X("load_sine_lab", "lab", {"x_load_time": (.06, "sine", .45)}, "steps mprbs", "stair", "load torque sin(2 pi t/0.45 s)")
X("load_step_axis", "axis", {"x_load_time": (.06, "step", .8)}, "steps mprbs", "ramps", "load torque from t = 0.8 s on",
  ch="iwt", cpr=4e4)
X("load_ramp_fly", "fly", {"x_load_time": (.06, "ramp", 10.0)}, "steps mprbs", "stair",
  "load torque that grows with time")
X("grease_warms_gear", "gear", {"x_warm_friction": (3.0, 3.0)}, "mprbs stopgo", "steps",
  "viscous friction falls while warming up",
  T=8.0, dt=4e-3, b_mul=2.0)
X("dry_friction_falls", "axis", {"x_friction_time": (.02, .12, .8)}, "stopgo steps", "mprbs",
  "dry friction that falls in time (its mean is coulomb)", ch="iw", T=2.5, acc=["coulomb"])
X("backdrive_gear", "gear", {"x_backdrive": (.75, 1.9)}, "mprbs stopgo", "steps",
  "gear with different loss when driven back (symmetric part is load_friction)", ch="iw", acc=["load_friction"],
  now="gear_efficiency")
X("sag_duty_lab", "lab", {"x_sag": .5}, "mprbs stair", "steps", "supply sags with duty: v - Rs d^2 i", now="supply_sag")
X("demag_fly", "fly", {"x_demag": (.06, 6.0)}, "mprbs prbs", "steps", "magnets weaken while warm", T=16.0, dt=.01,
  now="magnet_heating")
X("driver_lag_lab", "lab", {"x_driver_lag": 8e-3}, "mprbs steps", "stopgo",
  "driver with a first-order lag on the voltage")
X("current_limit_fly", "fly", {"x_limit": .8}, "prbs mprbs", "steps", "driver chops at a current limit", h_=5e-5,
  now="driver_current_limit")
X("clutch_servo", "servo", {"x_clutch": .8}, "mprbs steps", "ramps", "slipping clutch bounds the torque", ch="w")
X("crank_servo", "servo", {"x_crank": .2}, "mprbs:0.5 steps:0.4", "chirp:0.6", "inertia depends on the angle", ch="wt")
X("eccentric_disc_gear", "gear", {"x_eccentric": .06}, "steps mprbs", "ramps", "speed from an eccentric encoder disc",
  ch="iwt", zero=False)
X("cubic_drag_lab", "lab", {"x_cubic": .25}, "stair mprbs", "ramps",
  "drag with the cube of the speed (quadratic is near)",
  acc=["quadratic_drag"])
