"""JAX's options: what the environment sets changes no number and breaks no program."""

import json

import jax
import pytest
from pretend import USUAL, python

from hector_jax.cli import doctor
from hector_jax.core import numerics

# a net's parameters and draws of the kinds that we use; a reference, whose ranks and dtypes are
# promoted and which takes NumPy's arrays; and one that is NaN
PROGRAM = """
import hashlib, json
import jax, numpy as np
import jax.numpy as jnp
from hector_jax.control.reference import Anchor, named_command, reference_at
from hector_jax.core import numerics
from hector_jax.core.runtime import setup_jax
from hector_jax.grfm.network import VARIANTS
setup_jax()
key = jax.random.key(3)
net = VARIANTS["residual"].init(key, feet=2, axes=6, hidden=(4,))
draws = jax.random.normal(key, 5), jax.random.permutation(key, 9), jax.random.uniform(key, 5)
anchor = Anchor(np.zeros(3), np.float32(0.3), np.int32(2))
reference = reference_at(0.01, named_command("s"), anchor, 77)
lost = reference_at(0.01, named_command("s"), anchor._replace(yaw=np.nan), 77)
ranks = jnp.ones((2, 3)) + jnp.ones(3, jnp.float32) * jnp.arange(3)
content = hashlib.sha256()
for leaf in jax.tree.leaves((net, draws, reference, lost, ranks)):
    content.update(f"{leaf.dtype}{leaf.shape}".encode() + np.asarray(leaf).tobytes())
options = {name: repr(value) for name, value in jax.config.values.items()}
print(json.dumps([content.hexdigest(), numerics.not_used(), options]))
"""


def computed(**variables):
    """The hash of the numbers, the variables that were not used, and JAX's options."""
    done = python("-c", PROGRAM, env=USUAL | variables)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def usual():
    return computed()


def another(option):
    """Text for a value of an option that is not its default, for any that JAX has or will have."""
    kind, _, known = jax.config.meta[option]
    value = getattr(jax.config, option, None) or jax.config.values[option]
    if kind == "enum":
        return next(word for word in known["enum_values"] if word != value)
    if kind == "enum_class":
        return next(x.name.lower() for x in known["enum_class"] if x != value)
    if kind is bool:
        return str(not value)
    return "/tmp/other" if kind is str else str((value or 0) + 1)


def test_options_of_devices_and_logs_are_the_users_and_no_other_can_be_set_from_outside(usual):
    options = [name for name in jax.config.values if not name.startswith(numerics._FREE)]
    words = {"jax_default_device": "cpu", "jax_pjrt_client_create_options": ""}
    variables = {name.upper(): words.get(name) or another(name) for name in options}
    numbers, not_used, after = computed(**variables)
    assert len(options) > 50
    assert not_used == variables
    assert {n: (after[n], usual[2][n]) for n in after if after[n] != usual[2][n]} == {}
    assert numbers == usual[0]
    free = {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "3", "JAX_LOG_COMPILES": "0"}
    numbers, not_used, options = computed(**free)
    assert (numbers, not_used) == (usual[0], {})
    assert options["jax_num_cpu_devices"] == "3"


def test_the_doctor_lists_what_the_environment_sets(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=0")
    monkeypatch.setattr(doctor, "not_used", lambda: {"JAX_DEBUG_NANS": "1"})
    monkeypatch.setattr(doctor, "load_robot", lambda: json.loads("no robot"))  # nor a walk
    facts, _ = doctor.examine()
    assert facts["JAX_PLATFORMS"] == "cpu (used)"
    assert facts["XLA_FLAGS"] == "--xla_backend_optimization_level=0 (used)"
    assert facts["JAX_DEBUG_NANS"] == "1 (not used: jax_debug_nans is False)"
