"""Functions of the host that a compiled program on a CPU calls, by XLA's interface in C.

JAX's own callbacks take several times as long, and no program with one goes into the compilation
cache: here a program knows its function by a number alone. XLA refuses a handler for a version of
the interface that is not compatible.

Source: xla/ffi/api/c_api.h, in the folder of `jax.ffi.include_dir`.
"""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes import POINTER, Structure, c_char, c_int, c_int32, c_int64, c_size_t, c_uint32, c_void_p
from functools import cache
from itertools import count
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from hector_jax.core.arrays import Array

_VERSION = 0, 1  # of the interface


class _Version(Structure):
    _fields_ = (("size", c_size_t), ("next", c_void_p), ("major", c_int), ("minor", c_int))


class _Metadata(Structure):
    _fields_ = (("size", c_size_t), ("version", _Version), ("traits", c_uint32))


class _Extension(Structure):
    _fields_ = (
        ("size", c_size_t),
        ("type", c_int),
        ("next", c_void_p),
        ("metadata", POINTER(_Metadata)),
    )


class _Buffer(Structure):
    _fields_ = (
        ("size", c_size_t),
        ("next", c_void_p),
        ("dtype", c_int),
        ("data", c_void_p),
        ("rank", c_int64),
        ("shape", POINTER(c_int64)),
    )


class _Buffers(Structure):
    _fields_ = (
        ("size", c_size_t),
        ("next", c_void_p),
        ("count", c_int64),
        ("types", c_void_p),
        ("buffers", POINTER(POINTER(_Buffer))),
    )


class _Frame(Structure):
    _fields_ = (
        ("size", c_size_t),
        ("extension", POINTER(_Extension)),
        ("api", c_void_p),
        ("context", c_void_p),
        ("stage", c_int),
        ("inputs", _Buffers),
        ("outputs", _Buffers),
    )


_TYPES = {11: np.dtype(np.float32), 12: np.dtype(np.float64)}  # by XLA's numbers
_running: dict[int, Callable[[_Buffer, _Buffer], None]] = {}
_interrupts: list[BaseException] = []


@ctypes.CFUNCTYPE(c_void_p, POINTER(_Frame))
def _handler(frame: Any) -> None:
    try:
        now = frame.contents
        if now.extension:  # XLA asks for the version when the handler is registered
            metadata = now.extension.contents.metadata.contents
            metadata.version.major, metadata.version.minor = _VERSION
            metadata.traits = 0
            return
        number, x = now.inputs.buffers[:2]
        function = _running[c_int32.from_address(number.contents.data).value]
        function(x.contents, now.outputs.buffers[0].contents)
    except BaseException as error:  # a signal came before or after the function
        _interrupts.append(error)


@cache
def _register() -> str:
    name = "hector_jax_host_call"
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(_handler), platform="cpu")
    return name


def host_call(number: Int[Array, ""], x: Float[Array, " n"], size: int) -> Float[Array, " size"]:
    """Call the function of a number from `serving`, as function(x, result), in a program on a CPU.

    The function writes into result. XLA leaves a call out whose result is not used, and may make
    one of two with the same inputs.
    """
    call = jax.ffi.ffi_call(_register(), jax.ShapeDtypeStruct((size,), x.dtype))
    return call(number, x)


@contextmanager
def serving(function: Callable[[np.ndarray, np.ndarray], None]) -> Iterator[np.int32]:
    """Number a function that programs call while the context lasts.

    A program cannot raise: after an error the function is not called again, and the error is raised
    at the end.
    """
    errors: list[BaseException] = []
    views: dict[int, np.ndarray] = {}  # by address: a loop passes the same memory in each turn

    def view(buffer: _Buffer) -> np.ndarray:
        address = buffer.data
        if address not in views:
            dtype = _TYPES[buffer.dtype]
            memory = (c_char * (buffer.shape[0] * dtype.itemsize)).from_address(address)
            views[address] = np.frombuffer(memory, dtype)
        return views[address]

    def guarded(x: _Buffer, result: _Buffer) -> None:
        if errors:
            return
        try:
            function(view(x), view(result))
        except BaseException as error:
            errors.append(error)

    number = next(n for n in count() if _running.setdefault(n, guarded) is guarded)
    try:
        yield np.int32(number)
    finally:
        del _running[number]
    if raised := [*_interrupts, *errors]:
        _interrupts.clear()
        raise raised[0]
