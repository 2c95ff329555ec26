# SPDX-License-Identifier: MIT
"""A motor with its inverter's ramp, as a pure function of given time. Touches nothing but the standard library.

The ramp is analytic: between two changes of target the frequency at any instant is computed, not integrated, so that
the size of the host's steps never shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise


@dataclass(frozen=True, slots=True)
class Ramp:
    """Output frequency from `start` at `since` to `target`; speeding up and slowing down have rates of their own.

    Rates are Hz/s; infinity jumps. Through zero it slows down to 0, then speeds up.
    """

    since: float = 0.0
    start: float = 0.0
    target: float = 0.0
    up: float = math.inf
    down: float = math.inf

    def _legs(self) -> list[tuple[float, float, float]]:
        """(from, to, seconds) of each monotone piece."""
        through_zero = self.start * self.target < 0
        corners = [self.start, 0.0, self.target] if through_zero else [self.start, self.target]
        return [(a, b, abs(b - a) / (self.up if abs(b) > abs(a) else self.down))
                for a, b in pairwise(corners)]

    @property
    def end(self) -> float:
        """When the target is reached."""
        return self.since + sum(seconds for _, _, seconds in self._legs())

    def at(self, now: float) -> tuple[float, float]:
        """Frequency (Hz, negative in reverse) and its slope (Hz/s) at `now`."""
        elapsed = max(now - self.since, 0.0)
        for a, b, seconds in self._legs():
            if elapsed < seconds:
                slope = (b - a) / seconds
                return a + slope * elapsed, slope
            elapsed -= seconds
        return self.target, 0.0


class Motor:
    """An induction motor on an inverter, with the values of the last `advance`; frequencies in reverse are negative.

    `load` is the opposing torque as a share of the rated torque, constant while it turns; `inertia` the seconds that
    rated torque would need to reach the rated frequency. Both may be changed at any time.
    """

    def __init__(self, *, rated_current: float = 3.3, rated_frequency: float = 60.0, rated_power: float = 750.0,
                 load: float = 0.5, inertia: float = 0.5) -> None:
        self.rated_current = rated_current
        self.rated_frequency = rated_frequency
        self.rated_power = rated_power
        self.load = load
        self.inertia = inertia
        self.frequency = 0.0
        """Output frequency, Hz."""
        self.current = 0.0
        """Output current, A: magnetising and torque current at a right angle; 0 while the output is off."""
        self.torque = 0.0
        """Share of the rated torque, negative when it brakes or pulls in reverse."""
        self.powered = False
        """Whether the inverter feeds the motor."""
        self._ramp = Ramp()

    @property
    def target(self) -> float:
        """Where the ramp leads, Hz."""
        return self._ramp.target

    @property
    def arrived(self) -> bool:
        """Whether the ramp has ended."""
        return self.frequency == self._ramp.target

    @property
    def settles(self) -> float:
        """When the ramp ends, or has ended."""
        return self._ramp.end

    @property
    def power(self) -> float:
        """Output power, W, without losses."""
        return self.rated_power * self.torque * self.frequency / self.rated_frequency

    def drive(self, now: float, target: float, up: float = math.inf, down: float = math.inf) -> None:
        """Feed the motor and lead it from where it is to `target`. The same call again changes nothing."""
        ramp = self._ramp
        if self.powered and (ramp.target, ramp.up, ramp.down) == (target, up, down):
            return
        self._ramp = Ramp(now, ramp.at(now)[0], target, up, down)
        self.powered = True
        self.advance(now)

    def cut(self, now: float) -> None:
        """Take the output away at once: the motor is no longer fed, whatever its shaft does."""
        self._ramp = Ramp(now)
        self.powered = False
        self.advance(now)

    def advance(self, now: float) -> None:
        """Live until `now`."""
        frequency, slope = self._ramp.at(now)
        turning = (frequency > 0) - (frequency < 0)
        torque = self.load * turning + self.inertia * slope / self.rated_frequency if self.powered else 0.0
        magnetising = 0.35
        share = math.hypot(magnetising, torque * math.sqrt(1 - magnetising**2)) if self.powered else 0.0
        self.frequency, self.torque, self.current = frequency, torque, self.rated_current * share
