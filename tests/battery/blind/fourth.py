"""A fourth blind battery with a plant of its own, written down before any run of the tool on it.

`acc`, `alts` and `whole` name what these records cannot distinguish from the truth, by reasoning on the equations.
In 'outside' cases `acc` is a part that does act beside the foreign shape, or the nearest of the library by its physics.
Noise, lost samples and converters differ from case to case: what is not given here is drawn with the case's seed.
"""

from __future__ import annotations

from battery.blind import fourth_plant
from battery.blind.build import Battery

B = Battery(fourth_plant)
S, D, N, X = B.single, B.pair, B.none, B.outside
SHAFT = {"ch": "iwt", "cpr": 40000, "anywhere": True}  # an absolute encoder on the shaft, and a tacho
LATE = ["speed_lag", "speed_delay", "speed_average"]

# One effect of the library each
S("brush_drop", "toy", {"brush_drop": .06}, "levels moves", "stairs", hum=.01)
S("winding_heating", "reel", {"winding_heating": (.5, 3.0)}, "prbs levels", "levels stairs")
S("magnet_heating", "scooter", {"magnet_heating": (.25, 3.0)}, "prbs levels", "stairs", T=10.0, dt=5e-3, h=1.25e-4)
S("inductance_saturation", "industrial", {"inductance_saturation": .4}, "levels prbs", "coast")
S("magnetic_saturation", "window", {"magnetic_saturation": .7}, "levels prbs", "moves", vbits=8)
S("driver_dead_band", "pump", {"driver_dead_band": .06}, "tones levels", "ramp", rho=.7)
S("driver_coast", "belt", {"driver_coast": ()}, "coast moves", "coast", nw=.004)
S("driver_current_limit", "industrial", {"driver_current_limit": .45}, "levels stairs", "prbs:0.8")
S("supply_sag", "scooter", {"supply_sag": .25}, "levels prbs", "stairs", rho=.6)
S("voltage_offset", "servo", {"voltage_offset": .03}, "levels tones", "ramp", ch="iwt")
S("coulomb", "coreless16", {"coulomb": .05}, "speed levels", "ramp:0.5", counts=16384)
S("coulomb_asymmetric", "pump", {"coulomb_asymmetric": (.03, .08)}, "levels ramp", "stairs",
  whole=[["coulomb", "constant_load"]])
S("stribeck", "servo", {"stribeck": (.03, .09, .05)}, "ramp:0.3 moves:0.4", "tones:0.3", ch="iwt", acc=["lugre"])
S("lugre", "servo", {"lugre": (.06, 1.6, .04, .03)}, "ramp:0.2 tones:0.25", "levels:0.25", ch="iwt", cpr=65536)
S("angular_friction", "planet", {"angular_friction": (.06, .7, 1, .5)}, "ramp:0.4 levels:0.5", "moves:0.5", **SHAFT)
S("viscous_asymmetric", "disc", {"viscous_asymmetric": .07}, "levels stairs", "chirp", drop=.08)
S("quadratic_drag", "pump", {"quadratic_drag": .25}, "stairs levels", "chirp", counts=16384)
S("eddy_brake", "coreless35", {"eddy_brake": (.08, .3)}, "stairs levels", "ramp")
S("load_friction", "belt", {"load_friction": .15}, "levels prbs", "tones", acc=["gear_efficiency"])
S("gear_efficiency", "planet", {"gear_efficiency": (.15, .7)}, "levels prbs", "tones", fixed=["J"])
S("constant_load", "window", {"constant_load": .1}, "speed levels", "stairs", ch="it", zero=True)
S("gravity", "servo", {"gravity": (.05, .7)}, "tones position:0.2", "levels", **SHAFT)
S("spring", "gimbal", {"spring": (.5, .3)}, "levels tones", "prbs", ch="wt")
S("cogging", "window", {"cogging": (.05, 10, .6)}, "ramp:0.3 levels:0.4", "moves:0.4", **SHAFT)
S("torque_ripple", "planet", {"torque_ripple": (.2, 7, .2)}, "levels moves", "stairs", jitter=.02, **SHAFT)
S("compliance", "scooter", {"compliance": (.55, 110.0, .04)}, "levels prbs", "chirp")
S("backlash", "servo", {"backlash": (.5, .06, 120.0, .2)}, "tones levels", "prbs", ch="iwt", cpr=65536)
S("speed_lag", "disc", {"speed_lag": 6e-3}, "levels prbs", "chirp", hum=.02)
S("speed_delay", "coreless35", {"speed_delay": 2.4e-3}, "prbs levels", "chirp")
S("speed_average", "pump", {"speed_average": .03}, "prbs levels", "tones")
S("speed_gain", "belt", {"speed_gain": .07}, "levels tones", "moves", ch="iwt")
S("speed_offset", "window", {"speed_offset": .03}, "levels stairs", "tones", ch="iwt")
S("current_lag", "industrial", {"current_lag": .012}, "levels prbs", "coast")
S("current_offset", "disc", {"current_offset": .03}, "tones levels", "stairs", rho=.5)
S("current_gain", "coreless16", {"current_gain": .15}, "levels prbs", "ramp", fixed=["R"])
S("supply_side_current", "scooter", {"supply_side_current": False}, "levels stairs", "tones")
S("measured_supply", "pump", {"measured_supply": ()}, "stairs levels", "tones", log="v_supply")
S("supply_per_run", "toy", {"supply_per_run": ()}, "levels stairs tones", "prbs")

# Two effects
D("coulomb_drag", "pump", {"coulomb": .04, "quadratic_drag": .15}, "stairs levels", "tones")
D("coulomb_cogging", "planet", {"coulomb": .04, "cogging": (.06, 8, .4)}, "ramp:0.4 levels:0.5", "moves:0.5", **SHAFT)
D("gravity_coulomb", "servo", {"gravity": (.08, 2.0), "coulomb": .04}, "tones position:0.3", "levels", **SHAFT)
D("compliance_coulomb", "scooter", {"compliance": (.5, 120.0, .05), "coulomb": .04}, "levels prbs", "tones")
D("dead_band_coulomb", "belt", {"driver_dead_band": .05, "coulomb": .05}, "tones levels", "moves")
D("brush_asymmetric", "toy", {"brush_drop": .05, "viscous_asymmetric": .05}, "levels stairs", "tones")
D("sag_drag", "pump", {"supply_sag": .2, "quadratic_drag": .15}, "stairs prbs", "levels", rho=.5)
D("heating_coulomb", "reel", {"winding_heating": (.6, 3.0), "coulomb": .03}, "prbs levels", "stairs")
D("heating_warm", "reel", {"winding_heating": (.6, 3.0), "winding_warm_start": ()}, "prbs levels prbs", "levels")
D("lag_coulomb", "disc", {"speed_lag": 5e-3, "coulomb": .05}, "levels ramp", "tones")
D("offset_delay", "coreless35", {"current_offset": .03, "speed_delay": 4e-3}, "prbs levels", "chirp")
D("load_coulomb", "window", {"constant_load": .06, "coulomb": .05}, "levels ramp", "stairs",
  whole=[["coulomb_asymmetric"]])
D("spring_coulomb", "gimbal", {"spring": (.5, 0.0), "coulomb": .05}, "levels tones", "prbs", ch="wt")
D("backlash_coulomb", "servo", {"backlash": (.5, .06, 120.0, .2), "coulomb": .03}, "tones levels", "prbs", ch="iwt",
  cpr=65536)
D("ripple_coulomb", "planet", {"torque_ripple": (.2, 5, 1.0), "coulomb": .05}, "levels moves", "stairs", **SHAFT)
D("saturation_brush", "window", {"magnetic_saturation": .7, "brush_drop": .05}, "levels prbs", "stairs")
D("limit_inductance", "industrial", {"driver_current_limit": .6, "inductance_saturation": .3}, "levels prbs", "stairs")
D("offset_eddy", "disc", {"voltage_offset": .03, "eddy_brake": (.08, .25)}, "stairs levels", "tones")
D("cogging_zeroed", "window", {"cogging": (.05, 6, .3), "encoder_zero": ()}, "ramp:0.3 levels:0.4", "moves:0.4",
  ch="iwt", cpr=40000, anywhere=True)
D("average_drag", "pump", {"speed_average": .04, "quadratic_drag": .2}, "prbs stairs", "levels")
D("measured_load_coulomb", "industrial", {"measured_load": (), "coulomb": .04}, "levels stairs", "ramp",
  log="tau_load")
D("coast_drag", "belt", {"driver_coast": (), "quadratic_drag": .15}, "coast coast", "levels coast")

# Nothing but the bench
N("white_coreless", "coreless16", "levels tones", "stairs")
N("quiet_disc", "disc", "levels prbs", "ramp", ni=.001, nw=.001, drop=0)
N("loud_window", "window", "levels stairs", "tones", ni=.05, nw=.05)
N("coloured_pump", "pump", "stairs chirp", "levels", rho=.9)
N("coloured_slow_toy", "toy", "tones levels", "moves", rho=.98, nw=.01)
N("counts_planet", "planet", "levels ramp", "moves", counts=20000)
N("counts_coarse_belt", "belt", "stairs levels", "tones", counts=5000)
N("counts_backward_scooter", "scooter", "levels prbs", "tones", counts=3000, backward=True, acc=LATE)
N("zeroed_servo", "servo", "moves levels", "tones", ch="it", zero=True, anywhere=True)
N("theta_only_belt", "belt", "levels tones", "prbs", ch="t")
N("omega_only_coreless", "coreless35", "stairs levels", "chirp", ch="w")
N("speed_loop_industrial", "industrial", "speed speed", "levels", hum=.02)
N("position_loop_servo", "servo", "position:0.5 position:0.5", "speed", ch="iwt", cpr=8000, zero=True)
N("position_loop_gimbal", "gimbal", "position:0.1 speed", "position:0.1", ch="wt")
N("hum_toy", "toy", "levels ramp", "stairs", hum=.06)
N("jitter_pump", "pump", "levels tones", "stairs", jitter=.08)
N("lost_rows_window", "window", "stairs levels", "moves", lost=.15)
N("dropped_disc", "disc", "levels prbs", "stairs", drop=.25)
N("pwm_scooter", "scooter", "levels stairs", "tones", pwm=4, h=2.5e-5)
N("other_columns_pump", "pump", "levels tones", "chirp", log="v_supply tau_load temp")
N("metered_reel", "reel", "levels stairs", "chirp", meter=.002, vbits=14)
N("one_run_coreless", "coreless35", "levels", "tones")
N("four_runs_coarse", "planet", "stairs levels tones prbs", "moves ramp", bits=7, vbits=7)

# What the library lacks
X("notch", "planet", {"x_notch": (.5, 9, .18)}, "levels moves", "stairs", "brushes that bridge segments", **SHAFT,
  acc=["torque_ripple"])
X("flux_memory", "industrial", {"x_flux_memory": (.25, .25)}, "levels prbs", "stairs", "iron that remembers currents")
X("one_way_flux", "toy", {"x_one_way_flux": .06}, "levels stairs", "tones", "magnets that differ with the direction")
X("open_coil", "window", {"x_open_coil": (.6, 3)}, "levels:0.5 moves:0.4", "stairs:0.5", "burnt segments", **SHAFT)
X("brush_noise", "toy", {"x_brush_noise": .35}, "levels prbs", "stairs", "a contact that wanders")
X("chopper", "toy", {"x_chopper": ()}, "lift lift", "lift", "one switch and a diode, current with gaps", ch="w", pwm=2,
  h=1e-5, nw=.006, damped=25, acc=["driver_coast"])
X("ripple", "servo", {"x_ripple": (.06, 100.0)}, "levels stairs", "tones", "a rectified supply")
X("slew", "disc", {"x_slew": .006}, "levels prbs", "stairs", "an output stage that changes slowly")
X("bus_capacitor", "scooter", {"x_bus_capacitor": (.3, .08)}, "levels prbs", "stairs", "a bus that sags late",
  acc=["supply_sag"])
X("foldback", "industrial", {"x_foldback": (.7, .25, 6e-3)}, "levels prbs", "stairs", "a limit that folds back",
  h=1.25e-5, acc=["driver_current_limit"])
X("gain_curve", "gimbal", {"x_gain_curve": 1.0}, "levels tones", "prbs", "a drive that gives less and less", ch="wt",
  acc=["magnetic_saturation"])
X("warm_grease", "pump", {"x_warm_grease": (.3, .5)}, "levels stairs", "levels", "grease that thins with work")
X("run_in", "coreless35", {"x_run_in": (.04, 2.0, .12)}, "levels ramp", "stairs", "a bearing that runs in",
  acc=["coulomb"])
X("thread", "servo", {"x_thread": (.12, 12.0)}, "levels lift", "tones", "a screw that cuts its thread", ch="iwt",
  acc=["coulomb"])
X("dwell", "window", {"x_dwell": (.04, 2.0, .05)}, "moves:0.4 ramp:0.3", "moves:0.4", "friction that grows at rest",
  acc=["coulomb", "stribeck", "lugre"])
X("root_load", "disc", {"x_root_load": .1}, "stairs levels", "tones", "a load by the root of the speed")
X("damper", "belt", {"x_damper": (.25, .2)}, "levels stairs", "tones", "a damper that cavitates one way",
  acc=["viscous_asymmetric"])
X("fan_stall", "pump", {"x_fan_stall": (.35, .6, .5)}, "stairs levels", "tones", "blades that stall",
  acc=["quadratic_drag"])
X("entrained", "pump", {"x_entrained": (.5, .15)}, "levels prbs", "stairs", "a fluid that turns along",
  acc=["quadratic_drag"])
X("rope_layers", "reel", {"x_rope_layers": (.03, .5, 150.0)}, "lift levels", "lift", "layers of rope on a drum",
  ch="iwt", acc=["constant_load", "spring"])
X("cable_wrap", "servo", {"x_cable_wrap": (.06, 1.0, 2.0)}, "tones levels", "tones", "a cable that winds up", ch="iwt",
  acc=["spring"])
X("ratchet", "window", {"x_ratchet": (12,)}, "tones levels", "tones", "a pawl", acc=["coulomb_asymmetric"])
X("detent", "planet", {"x_detent": (.06, 5)}, "ramp:0.4 levels:0.5", "moves:0.5", "a detent with flat tops", **SHAFT,
  acc=["cogging"])
X("tumbler", "servo", {"x_tumbler": (.05, .5)}, "tones levels", "ramp", "a loose weight in a drum", ch="iwt",
  acc=["gravity"])
X("gust", "scooter", {"x_gust": .06}, "levels stairs", "tones", "gusts")
X("eccentric_gear", "planet", {"x_eccentric_gear": .25}, "levels moves", "stairs", "a ratio that varies", **SHAFT)
X("governor", "coreless35", {"x_governor": .5}, "levels prbs", "stairs", "weights that fly out")
X("slip_clutch", "industrial", {"x_slip_clutch": (.5, .25)}, "levels prbs", "stairs", "a clutch that slips")
X("rubber", "disc", {"x_rubber": (.5, 250.0, .05, .4)}, "levels prbs", "chirp", "a coupling that stiffens",
  acc=["compliance"])
X("magnet_coupling", "pump", {"x_magnet_coupling": (.5, .6, 4, .05)}, "levels:0.5 prbs:0.3", "tones:0.6",
  "poles that pull through a wall", acc=["compliance"])
X("tracking_loop", "coreless16", {"x_tracking_loop": (700.0, .35)}, "levels prbs", "chirp", "a loop that overshoots",
  acc=LATE)
X("encoder_orders", "gimbal", {"x_encoder_orders": .03}, "levels:0.5 ramp:0.4", "tones:0.5", "an encoder off its axis",
  ch="wt", anywhere=True)
X("compressed", "scooter", {"x_compressed": 1.2}, "levels prbs", "stairs", "a current sensor that saturates")
X("drift", "disc", {"x_drift": (.06, .3)}, "levels stairs", "tones", "a zero that wanders", acc=["current_offset"])
X("crosstalk", "window", {"x_crosstalk": .06}, "levels prbs", "stairs", "a shunt that sees the voltage")
X("clock", "belt", {"x_clock": .012}, "levels prbs", "tones", "two clocks that run apart", acc=LATE)
X("encoder_slips", "servo", {"x_encoder_slips": (.6, .15)}, "levels moves", "tones", "an encoder that slips", ch="iwt")
X("tacho_flat", "pump", {"x_tacho_flat": 1.0}, "stairs levels", "tones", "a tacho that saturates")
