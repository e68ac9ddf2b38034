"""Faults of the simulated device, and what ends them."""

from .actions import simulator

MOTOR_TURN = 0.698  # rad of joint 2 for one turn of its rotor
J2 = [False, True, False, False]
NONE = [False] * 4
CUT_OFF, CONNECT = simulator(fault__cut_off=J2), simulator(fault__cut_off=NONE)
# The device counts the time from the moment at which the motor loses its power.
RESTART = simulator(fault__unplugged_time=0.03, fault__unplugged=J2)
SHORT_RESTART = simulator(fault__unplugged_time=0.015, fault__unplugged=J2)
RESTARTED = simulator(fault__unplugged_time=0.0, fault__unplugged=NONE)
SILENCE, END_SILENCE = simulator(fault__bus_silent=True), simulator(fault__bus_silent=False)
ERROR, NO_ERROR = simulator(fault__error=[0, 5, 0, 0]), simulator(fault__error=[0] * 4)
JUMP, NO_JUMP = (simulator(fault__encoder_error=[0.0, error, 0.0, 0.0]) for error in (MOTOR_TURN, 0.0))
