# SPDX-License-Identifier: MIT
"""The motor's ramp is analytic: the size of the steps does not show."""

import math
import random

import pytest

from dpmaster.emulator.motor import Motor, Ramp


def test_it_ramps_up_holds_and_ramps_down() -> None:
    motor = Motor()
    motor.drive(0.0, 30.0, up=6.0, down=3.0)
    motor.advance(2.5)
    assert motor.frequency == 15.0 and not motor.arrived
    motor.advance(5.0)
    assert motor.frequency == 30.0 and motor.arrived and motor.settles == 5.0
    motor.drive(7.0, 0.0, up=6.0, down=3.0)
    motor.advance(12.0)
    assert motor.frequency == 15.0
    motor.advance(17.0)
    assert motor.frequency == 0.0 and motor.arrived


def test_reversing_slows_down_to_zero_and_speeds_up_again() -> None:
    ramp = Ramp(since=10.0, start=30.0, target=-20.0, up=5.0, down=10.0)
    assert ramp.at(11.5) == (15.0, -10.0)
    assert ramp.at(13.0)[0] == 0.0
    assert ramp.at(15.0) == (-10.0, -5.0)
    assert ramp.end == 17.0
    assert ramp.at(17.0) == (-20.0, 0.0)


def test_a_rate_without_limit_jumps() -> None:
    motor = Motor()
    motor.drive(1.0, 50.0)
    assert motor.frequency == 50.0 and motor.arrived


def test_the_same_command_again_changes_nothing() -> None:
    motor = Motor()
    for i in range(51):
        motor.drive(i / 10, 30.0, up=6.0, down=6.0)
        motor.advance(i / 10)
    assert motor.frequency == 30.0


def test_the_size_of_the_steps_does_not_matter() -> None:
    seed = random.randrange(2**32)
    print(f"seed {seed}")
    rng = random.Random(seed)
    commands = sorted((rng.uniform(0, 20), rng.uniform(-60, 60)) for _ in range(8))
    coarse, fine = Motor(), Motor()
    times = sorted([t for t, _ in commands] + [rng.uniform(0, 25) for _ in range(300)])
    for motor, steps in ((coarse, [t for t, _ in commands]), (fine, times)):
        pending = dict(commands)
        for t in steps:
            motor.advance(t)
            if t in pending:
                motor.drive(t, pending[t], up=7.0, down=11.0)
        motor.advance(21.3)
    assert coarse.frequency == pytest.approx(fine.frequency, abs=1e-9)


def test_current_and_torque_mean_something() -> None:
    motor = Motor(rated_current=4.0, load=0.0, inertia=1.0)
    assert motor.current == 0.0
    motor.drive(0.0, 60.0, up=6.0, down=6.0)
    motor.advance(1.0)
    speeding_up = motor.current
    assert motor.torque == pytest.approx(0.1)
    motor.advance(10.0)
    assert 0 < motor.current < speeding_up  # magnetising current alone
    motor.load = 1.0
    motor.advance(11.0)
    assert motor.current == pytest.approx(4.0) and motor.power == pytest.approx(motor.rated_power)
    motor.load = 0.0
    motor.drive(12.0, 0.0, up=6.0, down=6.0)
    motor.advance(13.0)
    assert motor.torque == pytest.approx(-0.1)
    motor.cut(14.0)
    assert (motor.frequency, motor.current, motor.torque, motor.powered) == (0.0, 0.0, 0.0, False)


def test_time_before_the_command_is_its_beginning() -> None:
    assert Ramp(since=5.0, start=2.0, target=math.pi).at(4.0) == (math.pi, 0.0)
    assert Ramp(since=5.0, start=2.0, target=8.0, up=1.0).at(4.0) == (2.0, 1.0)
