"""A compiled program calls functions of the host; their errors are raised where it was called."""

import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax.core.host_call import host_call, serving


@jax.jit
def five_times(number, x):
    """Return x after five calls, each of which gets the result of the one before."""
    return jax.lax.fori_loop(0, 5, lambda _, x: host_call(number, 2.0 * x, len(x)), x)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_each_call_gets_what_the_last_one_wrote(dtype):
    seen = []

    def add_one(x, result):
        seen.append(x.copy())
        result[:] = x + 1.0

    with serving(add_one) as number:
        result = five_times(number, np.arange(3.0, dtype=dtype))
    assert result.dtype == dtype
    expected = np.arange(3.0)
    for x in seen:
        np.testing.assert_array_equal(x, 2.0 * expected)
        expected = 2.0 * expected + 1.0
    np.testing.assert_array_equal(result, expected)
    assert len(seen) == 5


def test_two_functions_at_once_are_told_apart():
    def adds(step):
        return lambda x, result: np.add(x, step, out=result)

    with serving(adds(1.0)) as first, serving(adds(2.0)) as second:
        one, two = (five_times(number, jnp.zeros(1)) for number in (first, second))
    assert (one.item(), two.item()) == (31.0, 62.0)


def test_an_error_ends_the_calls_and_is_raised():
    calls = []

    def fails(x, result):
        calls.append(x[0])
        raise ValueError("of the plant")

    with pytest.raises(ValueError, match="of the plant"), serving(fails) as number:
        five_times(number, jnp.ones(1))
    assert calls == [2.0]
    with serving(lambda x, result: np.copyto(result, x)) as number:  # nothing of it is left
        assert five_times(number, jnp.ones(1)).item() == 32.0


@pytest.mark.parametrize("within", [True, False])
def test_an_interrupt_is_raised_whenever_it_comes(within, monkeypatch):
    """A signal is handled between two lines of Python: of the function, or of its caller."""
    from hector_jax.core import host_call as module

    def interrupt(*_):
        signal.raise_signal(signal.SIGINT)

    class Interrupted(dict):
        __getitem__ = interrupt

    if not within:
        monkeypatch.setattr(module, "_running", Interrupted())
    with pytest.raises(KeyboardInterrupt), serving(interrupt) as number:
        five_times(number, jnp.ones(1))
