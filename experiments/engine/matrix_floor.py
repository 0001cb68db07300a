"""Time of an iteration's matrix products: each shape of the traced program, timed alone with operands in cache.

On an idle machine, the sum estimates the least time of these products; the rest of an iteration is other work.  On a
busy machine, the sum is no bound: iterations have been faster.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr

from experiments.core.results import Table, named_table
from experiments.core.timing import interleaved

REPEATS = 16  # products of a timed call, so that the time of a call itself does not count
SHOWN = 12  # shapes that a table lists by themselves
PRODUCTS = ("dot_general", "linear", "conv_general_dilated")


class Product(NamedTuple):
    """Shapes of both operands, and the axes that are contracted and batched, as `jax.lax.dot_general` takes them."""

    left: tuple[int, ...]
    right: tuple[int, ...]
    axes: tuple[Any, Any]

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Batch, rows, columns, and terms of each sum."""
        (contracted, _), (batch, _) = self.axes
        terms, batched = (math.prod(self.left[i] for i in axes) for axes in (contracted, batch))
        rows, columns = (math.prod(shape) // terms // batched for shape in (self.left, self.right))
        return batched, rows, columns, terms

    @property
    def flops(self) -> float:
        """Multiplications and additions."""
        return 2.0 * math.prod(self.sizes)

    @property
    def name(self) -> str:
        """Such as `8 × (64 × 32 · 32 × 96)`."""
        batch, rows, columns, terms = self.sizes
        one = f"{rows} × {terms} · {terms} × {columns}"
        return one if batch == 1 else f"{batch} × ({one})"


class TimedProduct(NamedTuple):
    """Products of one name in an iteration: their number, operations, and seconds of all of them alone."""

    name: str
    number: int
    flops: float
    seconds: float


def equations(jaxpr: Jaxpr, loops: int | None = None) -> Iterator[tuple[Any, int]]:
    """Every product and convolution of a program and how often it is computed; of a choice those of the longest branch.

    Raises:
      ValueError: a product within a `while` loop, whose rounds `loops` does not give; a `scan` knows its own.
    """
    for eqn in jaxpr.eqns:
        name, params = eqn.primitive.name, eqn.params
        if name in PRODUCTS:
            yield eqn, 1
            continue
        inner = [list(equations(program, loops)) for program in _programs(params)]
        if name == "cond":
            inner = [max(inner, key=lambda branch: sum(n * flops(e) for e, n in branch), default=[])]
        if name == "while" and loops is None and any(inner):
            raise ValueError("a product stands in a while loop: how often it turns is unknown; count it by hand")
        times = params["length"] if name == "scan" else loops or 1 if name == "while" else 1
        yield from ((found, times * count) for branch in inner for found, count in branch)


def _programs(params: Mapping[str, Any]) -> list[Jaxpr]:
    """Programs among the parameters of an operation: a loop's body, branches, a function that is called."""
    leaves = jax.tree.leaves(list(params.values()), is_leaf=lambda x: isinstance(x, (Jaxpr, ClosedJaxpr)))
    return [x.jaxpr if isinstance(x, ClosedJaxpr) else x for x in leaves if isinstance(x, (Jaxpr, ClosedJaxpr))]


def flops(eqn: Any) -> float:
    """Multiplications and additions of a product or a convolution."""
    made = 2.0 * math.prod(eqn.outvars[0].aval.shape)
    left, right = (v.aval.shape for v in eqn.invars)
    if eqn.primitive.name == "conv_general_dilated":
        return made * math.prod(right) / right[eqn.params["dimension_numbers"].rhs_spec[0]]
    ((contracted, _), _) = _axes(eqn)
    return made * math.prod(left[i] for i in contracted)


def _axes(eqn: Any) -> Any:
    """Contracted and batched axes; those of `linear` are always the last of the rows and the first of the weights."""
    return eqn.params.get("dimension_numbers", (((len(eqn.invars[0].aval.shape) - 1,), (0,)), ((), ())))


def count_flops(function: Callable[..., Any], *arguments: Any) -> float:
    """Operations of the products and convolutions of a call; raises as `equations`."""
    return math.fsum(count * flops(eqn) for eqn, count in equations(jax.make_jaxpr(function)(*arguments).jaxpr))


def products(jaxpr: Jaxpr, loops: int) -> Counter[Product]:
    """Number of each matrix product in a program whose `while` loops take so many rounds."""
    found: Counter[Product] = Counter()
    for eqn, count in equations(jaxpr, loops):
        left, right = (tuple(v.aval.shape) for v in eqn.invars)
        found[Product(left, right, _axes(eqn))] += count
    return found


def time_products(jaxpr: Jaxpr, loops: int, rounds: int) -> tuple[TimedProduct, ...]:
    """Time every shape of a program's `products` alone, fastest of the rounds; the slowest in sum first."""
    counts = products(jaxpr, loops)
    calls = {str(product): _repeated(product) for product in counts}
    for call in calls.values():
        jax.block_until_ready(call())
    fastest = {key: float(s.min()) / REPEATS for key, s in interleaved(calls, range(rounds)).items()}
    merged: dict[str, TimedProduct] = {}
    for p, count in counts.items():
        before = merged.get(p.name, TimedProduct(p.name, 0, 0.0, 0.0))
        work, seconds = before.flops + count * p.flops, before.seconds + count * fastest[str(p)]
        merged[p.name] = TimedProduct(p.name, before.number + count, work, seconds)
    return tuple(sorted(merged.values(), key=lambda t: -t.seconds))


def floor_table(prefix: int, found: Sequence[TimedProduct], step_s: float) -> Table:
    """The slowest shapes, all others together, and the sum."""
    whole, rest = _together("all", found), found[SHOWN:]
    shown = [*found[:SHOWN], *([_together(f"{len(rest)} others", rest)] if rest else []), whole]
    return named_table(
        f"Matrix products of an iteration at prefix {prefix}, each shape alone",
        [
            {
                "product": one.name,
                "count": one.number,
                "work": one.flops / 1e9,
                "speed": one.flops / one.seconds / 1e9,
                "time": 1e3 * one.seconds,
                "share": one.seconds / step_s,
            }
            for one in shown
        ],
        formats={"speed": ",.0f", "work": ".2f", "time": ".1f", "share": ".3f"},
        units={"work": "GFLOP", "speed": "GFLOP/s", "time": "ms"},
        meanings={
            "product": "rows × terms · terms × columns, batched where a number precedes",
            "speed": "fastest of the rounds, on warm operands",
            "share": "of the fastest iteration",
        },
    )


def _together(name: str, found: Sequence[TimedProduct]) -> TimedProduct:
    return TimedProduct(name, sum(t.number for t in found), sum(t.flops for t in found), sum(t.seconds for t in found))


def _repeated(product: Product) -> Any:
    """A call that computes a product several times, each from an operand that the one before has changed."""
    left, right = (jnp.ones(shape, jnp.float32) for shape in (product.left, product.right))

    def again(_: int, left: jax.Array) -> jax.Array:
        found = jax.lax.optimization_barrier(jax.lax.dot_general(left, right, product.axes))
        return left.at[(0,) * left.ndim].add(1e-9 * found[(0,) * found.ndim])

    program = jax.jit(lambda left: jax.lax.fori_loop(0, REPEATS, again, left))
    return lambda: program(left)
