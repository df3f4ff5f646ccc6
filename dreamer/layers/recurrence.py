"""A scan whose weight gradients are one matrix product over all steps.

Differentiating an ordinary scan adds a weight gradient at every step of the backward pass: T small products and T
read-modify-writes of every weight. Here the backward scan only returns the cotangent of each product, and the weight
gradient is one product over T * B rows, accumulated in float32. Of each step the backward pass keeps what `keep` marks,
results of products and of sums, and computes the rest again: that is cheaper than writing and reading it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name

KEPT = "kept"
"""Name of what `keep` marks."""
Tree = Any
Step = Callable[[dict[str, jax.Array], Tree, dict[str, jax.Array], Tree], tuple[Tree, Tree, dict[str, jax.Array]]]


def keep(x: jax.Array) -> jax.Array:
    """`x`, which the backward pass of `scan_products` reads instead of computing it again."""
    return checkpoint_name(x, KEPT)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def scan_products(
    step: Step, unroll: int, weights: dict[str, jax.Array], carry: Tree, terms: dict[str, jax.Array], inputs: Tree
) -> tuple[Tree, Tree]:
    """Scan `step` over the leading axis of terms and inputs.

    Args:
        step: (weights, carry, terms_t, inputs_t) -> (carry, outputs_t, operands_t). For every weight the step computes
            `operand @ weight + terms_t[name]` once and returns the operand under the same name. Weights are
            (I, O), with operand (B, I), or (G, I, O), with operand (B, G, I).
        unroll: steps per loop body.
        weights: by name.
        carry: differentiable initial carry.
        terms: (T, B, ...) differentiable, one for every weight; further names are allowed.
        inputs: (T, ...) not differentiated.

    Returns:
        Last carry and stacked outputs.
    """
    (last, outputs), _ = _run(step, unroll, weights, carry, terms, inputs)
    return last, outputs


def _run(
    step: Step, unroll: int, weights: dict[str, jax.Array], carry: Tree, terms: dict[str, jax.Array], inputs: Tree
) -> tuple[tuple[Tree, Tree], dict[str, jax.Array]]:
    def body(carry: Tree, x: Tree) -> tuple[Tree, Tree]:
        carry, outputs, operands = step(weights, carry, *x)
        return carry, (outputs, operands)

    last, (outputs, operands) = jax.lax.scan(body, carry, (terms, inputs), unroll=unroll)
    return (last, outputs), operands


def _forward(
    step: Step, unroll: int, weights: dict[str, jax.Array], carry: Tree, terms: dict[str, jax.Array], inputs: Tree
) -> tuple[Any, Any]:
    lean = jax.checkpoint(step, prevent_cse=False, policy=jax.checkpoint_policies.save_only_these_names(KEPT))

    def run(carry: Tree, terms: dict[str, jax.Array]) -> tuple[Any, dict[str, jax.Array]]:
        return _run(lean, unroll, weights, carry, terms, inputs)

    result, pullback, operands = jax.vjp(run, carry, terms, has_aux=True)
    return result, (pullback, operands, weights, inputs)


def _backward(step: Step, unroll: int, residuals: Any, cotangent: Any) -> tuple[Any, ...]:
    pullback, operands, weights, inputs = residuals
    d_carry, d_terms = pullback(cotangent)
    d_weights = {name: _weight_gradient(operands[name], d_terms[name], weights[name]) for name in weights}
    return d_weights, d_carry, d_terms, jax.tree.map(_no_gradient, inputs)


def _weight_gradient(operand: jax.Array, cotangent: jax.Array, weight: jax.Array) -> jax.Array:
    equation = "tbi,tbo->io" if weight.ndim == 2 else "tbgi,tbgo->gio"
    gradient = jnp.einsum(equation, operand, cotangent, preferred_element_type=jnp.float32)
    return gradient.astype(weight.dtype)


def _no_gradient(x: jax.Array) -> Any:
    if jnp.issubdtype(x.dtype, jnp.floating):
        return jnp.zeros_like(x)
    return np.zeros(x.shape, jax.dtypes.float0)  # what jax expects for whole numbers and flags


scan_products.defvjp(_forward, _backward)
