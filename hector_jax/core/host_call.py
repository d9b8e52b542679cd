"""Functions of the host that a compiled program on a CPU calls, by XLA's interface in C.

JAX's own callbacks take several times as long, and no program with one goes into the compilation
cache: here a program knows its function by a number alone. XLA refuses a handler of another major
version of the interface.

Source: xla/ffi/api/c_api.h, in the folder of `jax.ffi.include_dir`.
"""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes import POINTER, Structure, c_double, c_int, c_int64, c_size_t, c_uint32, c_void_p
from functools import cache
from itertools import count
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

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


HostFunction = Callable[[np.ndarray, np.ndarray], None]
_running: dict[float, Callable[[_Buffer, _Buffer], None]] = {}
_numbers = count()


@ctypes.CFUNCTYPE(c_void_p, POINTER(_Frame))
def _handler(frame: Any) -> None:
    now = frame.contents
    if now.extension:  # XLA asks for the version when the handler is registered
        metadata = now.extension.contents.metadata.contents
        metadata.version.major, metadata.version.minor = _VERSION
        metadata.traits = 0
        return
    number, x = now.inputs.buffers[:2]
    function = _running[c_double.from_address(number.contents.data).value]
    function(x.contents, now.outputs.buffers[0].contents)


@cache
def _register() -> str:
    name = "hector_jax_host_call"
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(_handler), platform="cpu")
    return name


def host_call(
    number: Float[Array, "1"], x: Float[Array, " n"], size: int
) -> Float[Array, " size"]:
    """Call the function of a number from `serving` in a program with 64 bits on a CPU.

    It is called as function(x, result) and writes into result. The program must use the result.
    """
    call = jax.ffi.ffi_call(_register(), jax.ShapeDtypeStruct((size,), x.dtype))
    return call(number, x)


@contextmanager
def serving(function: HostFunction) -> Iterator[Float[np.ndarray, "1"]]:
    """Number a function that programs call while the context lasts; errors are raised at its end.

    After an error it is not called again.
    """
    errors: list[BaseException] = []
    views: dict[int, np.ndarray] = {}  # by address: a loop passes the same memory in each turn

    def view(buffer: _Buffer) -> np.ndarray:
        address = buffer.data
        if address not in views:
            memory = (c_double * buffer.shape[0]).from_address(address)
            views[address] = np.frombuffer(memory)
        return views[address]

    def guarded(x: _Buffer, result: _Buffer) -> None:
        if not errors:
            try:
                function(view(x), view(result))
            except BaseException as error:  # a program cannot raise it
                errors.append(error)

    number = float(next(_numbers))
    _running[number] = guarded
    try:
        yield np.array([number])
    finally:
        del _running[number]
    if errors:
        raise errors[0]
