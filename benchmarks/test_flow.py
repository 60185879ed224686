"""Throughput of the flow, cost of an event, compile time. Run with the `bench` extra:

python -m pytest benchmarks -m benchmark -o addopts="" --benchmark-json benchmarks/flow.json
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import Free, Ticks

import nsjax
from nsjax.gallery import Motion, StickSlip


jax.config.update("jax_enable_x64", True)
pytestmark = pytest.mark.benchmark
LANES = 4096
TOLERANCES = diffrax.PIDController(rtol=1e-8, atol=1e-8)


def sweep(system, y0, t1, values, **kwargs):
    def lane(value):
        sol = nsjax.solve(
            system(value), 0.0, t1, y0(value), stepsize_controller=TOLERANCES, throw=False, max_events=4096, **kwargs
        )
        return sol.y1, sol.stats["num_steps"], sol.stats["num_events"]

    return jax.jit(lambda v: jax.lax.map(lane, v, batch_size=256)), values


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), diffrax.Dopri8()], ids=["Tsit5", "Dopri8"])
@pytest.mark.parametrize("model", ["smooth", "stick-slip"])
def test_throughput(benchmark, model, solver):
    """Lane-steps a second, with and without a switch."""
    values = jnp.linspace(0.1, 1.0, LANES)
    if model == "smooth":
        run, values = sweep(lambda v: Free(), lambda v: Motion(2.0, v), 100.0, values, solver=solver)
    else:
        run, values = sweep(lambda v: StickSlip(v_dr=v), lambda v: Motion(2.5, -0.5), 100.0, values, solver=solver)
    compiled = run.lower(values).compile()
    _, steps, events = benchmark.pedantic(
        lambda: jax.block_until_ready(compiled(values)), rounds=5, iterations=1, warmup_rounds=1
    )
    benchmark.extra_info["lane_steps"] = int(np.sum(steps))
    benchmark.extra_info["events"] = int(np.sum(events))
    benchmark.extra_info["lane_steps_per_second"] = float(np.sum(steps)) / benchmark.stats.stats.median


@pytest.mark.parametrize("rate", [1.0, 10.0, 100.0])
def test_cost_of_an_event(benchmark, rate):
    """A lane with `rate` events a unit of time, over ten units."""
    values = jnp.linspace(0.9, 1.1, LANES) * rate
    run, values = sweep(lambda v: Ticks(rate=v), lambda v: 0.5, 10.0, values)
    compiled = run.lower(values).compile()
    _, _, events = benchmark.pedantic(
        lambda: jax.block_until_ready(compiled(values)), rounds=3, iterations=1, warmup_rounds=1
    )
    benchmark.extra_info["events"] = int(np.sum(events))
    benchmark.extra_info["microseconds_per_event"] = 1e6 * benchmark.stats.stats.median / int(np.sum(events))


@pytest.mark.parametrize("what", ["solve", "jacfwd"])
@pytest.mark.parametrize("solver", [diffrax.Tsit5(), diffrax.Dopri8()], ids=["Tsit5", "Dopri8"])
def test_compile_time(benchmark, solver, what):
    """From the Python function to the compiled program, persistent caches off."""

    def flow(x):
        return nsjax.solve(StickSlip(), 0.0, 10.0, Motion(x[0], x[1]), solver=solver, throw=False).y1

    fn = flow if what == "solve" else jax.jacfwd(flow)
    jax.config.update("jax_enable_compilation_cache", False)

    def build():
        jax.clear_caches()
        return jax.jit(fn).lower(jnp.array([2.5, -0.5])).compile()

    benchmark.pedantic(build, rounds=2, iterations=1)
