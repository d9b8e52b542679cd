"""Which device JAX finds here; asked in a process of its own, because JAX takes hold of it."""

import json

import jax

if __name__ == "__main__":
    device = jax.devices()[0]
    print(json.dumps({"platform": device.platform, "kind": device.device_kind}))
