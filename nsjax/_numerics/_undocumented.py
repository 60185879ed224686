"""What is used of JAX though its documentation does not mention it, and what happens where it is missing.

| name | used for | where it is missing |
|---|---|---|
| `Trace.parent_trace` | whether all transformations around a call execute at once | derivatives and batches that are not jitted are compiled without the options of quick compilation |
| `BatchTrace.axis_data` | how many lanes a batch has | batches that are not jitted are compiled without these options |
| `primitive_linearizations` | what is said of reverse mode without an adjoint | the message is that of JAX |
| `lower_jaxpr2` | functions that JAX replaces before it compiles (`jnp.searchsorted`, from 0.12 on) within primitives of our own | such functions raise an error there |

`tests/numerics/test_undocumented.py` runs with each of them missing.
"""  # noqa: E501

from typing import Any

from jax.interpreters import partial_eval as pe


try:
    from jax._src.interpreters.ad import primitive_linearizations
except ImportError:
    primitive_linearizations = {}

PARENT, AXIS = "parent_trace", "axis_data"
lower_jaxpr2: Any = getattr(pe, "lower_jaxpr2", None)
