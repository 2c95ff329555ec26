# SPDX-License-Identifier: MIT
"""Drives for asyncio: what of them waits, awaited. See `dpmaster.aio`; here are only the lists."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, Literal, TypeVar, overload

from dpmaster.aio import AsyncStation, Awaited, call
from dpmaster.drives.drive import Drive, DriveStatus
from dpmaster.drives.yaskawa_sip3 import SIP3Status, YaskawaSIP3
from dpmaster.drives.yaskawa_v7 import V7Status, YaskawaV7

__all__ = ["AsyncDrive", "AsyncYaskawaSIP3", "AsyncYaskawaV7"]

S = TypeVar("S", bound=DriveStatus)


class AsyncDrive(AsyncStation, Generic[S]):
    """`Drive.aio`. Commands that may ask the drive first are here, too; `stop` never waits."""

    def __init__(self, of: Drive[S]) -> None:
        super().__init__(of)
        self._drive = of

    run = Awaited(Drive.run)
    run_forward = Awaited(Drive.run_forward)
    run_reverse = Awaited(Drive.run_reverse)
    fault_reset = Awaited(Drive.fault_reset)
    faults = Awaited(Drive.faults)
    write = Awaited(Drive.write)

    async def wait_until(self, predicate: Callable[[S], bool], timeout: float) -> S:
        """`Drive.wait_until`."""
        return await call(self._drive.wait_until, predicate, timeout)

    async def wait_at_speed(self, timeout: float) -> S:
        """`Drive.wait_at_speed`."""
        return await call(self._drive.wait_at_speed, timeout)

    async def wait_stopped(self, timeout: float) -> S:
        """`Drive.wait_stopped`."""
        return await call(self._drive.wait_stopped, timeout)


class AsyncYaskawaV7(AsyncDrive[V7Status]):
    """`YaskawaV7.aio`."""

    def __init__(self, of: YaskawaV7) -> None:
        super().__init__(of)
        self._v7 = of

    write_parameter = Awaited(YaskawaV7.write_parameter)

    @overload
    async def read_parameter(self, name: int | str, count: Literal[1] = 1, *, timeout: float = 1.0) -> int: ...

    @overload
    async def read_parameter(self, name: int | str, count: int, *, timeout: float = 1.0) -> int | tuple[int, ...]: ...

    async def read_parameter(self, name: int | str, count: int = 1, *, timeout: float = 1.0) -> int | tuple[int, ...]:
        """`YaskawaV7.read_parameter`."""
        return await call(self._v7.read_parameter, name, count, timeout=timeout)


class AsyncYaskawaSIP3(AsyncDrive[SIP3Status]):
    """`YaskawaSIP3.aio`."""

    jog = Awaited(YaskawaSIP3.jog)
    fault_history = Awaited(YaskawaSIP3.fault_history)
    clear_fault_history = Awaited(YaskawaSIP3.clear_fault_history)
    read = Awaited(YaskawaSIP3.read)
    write = Awaited(YaskawaSIP3.write)
    enter = Awaited(YaskawaSIP3.enter)
    read_pnu = Awaited(YaskawaSIP3.read_pnu)
    write_pnu = Awaited(YaskawaSIP3.write_pnu)
    elements = Awaited(YaskawaSIP3.elements)
    read_array = Awaited(YaskawaSIP3.read_array)
    read_register = Awaited(YaskawaSIP3.read_register)
    read_registers = Awaited(YaskawaSIP3.read_registers)
    write_register = Awaited(YaskawaSIP3.write_register)
    loop_back = Awaited(YaskawaSIP3.loop_back)
    assign_outputs = Awaited(YaskawaSIP3.assign_outputs)
    assign_inputs = Awaited(YaskawaSIP3.assign_inputs)
