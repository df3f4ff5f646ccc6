"""What people look like: two legs that walk, a trunk and a head, as capsules that are seen, scanned and hit."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from whill_mjx.world.people.crowd import TRUNK as WIDTH
from whill_mjx.world.people.crowd import People
from whill_mjx.world.people.law import step_length
from whill_mjx.world.solids import Rounds, Solids

PARTS = 4
"""Capsules of a person: left leg, right leg, trunk, head."""
TOUCHING = 3
"""How many of them the vehicle can meet; from above, the head lies within the trunk."""
RADII = (0.045, 0.045, WIDTH, 0.062)
"""Of the capsules, as shares of the height."""
HIP, FOOT, APART, LIFT = 0.50, 0.05, 0.05, 0.05
"""Heights of a leg's ends, its distance from the middle, and how far a foot is lifted; shares of the height."""
TRUNK, HEAD = (0.56, 0.74), (0.91, 0.935)
"""Lower and upper end of the axis; shares of the height."""
SKIN = ((0.80, 0.62, 0.50), (0.55, 0.38, 0.28), (0.92, 0.76, 0.64))
SHIRTS = ((0.25, 0.30, 0.45), (0.62, 0.16, 0.16), (0.85, 0.84, 0.80), (0.20, 0.42, 0.30), (0.72, 0.55, 0.20))
TROUSERS = ((0.16, 0.17, 0.22), (0.30, 0.26, 0.22), (0.12, 0.12, 0.12))


def skeleton(people: People) -> tuple[jax.Array, jax.Array]:
    """Both ends (N, PARTS, 3) [m] of the axes of everybody's capsules."""
    tall = people.height
    ahead = jnp.stack([jnp.cos(people.heading), jnp.sin(people.heading)], -1)
    left = jnp.stack([-ahead[:, 1], ahead[:, 0]], -1)
    speed = jnp.sqrt(jnp.sum(people.velocity**2, -1))
    swing = step_length(speed) / 2  # how far a foot comes ahead of the hip

    def at(share, aside=0.0, along=0.0, up=0.0):
        place = people.position + jnp.asarray(along)[..., None] * ahead + (aside * tall)[:, None] * left
        return jnp.concatenate([place, (share * tall + up)[:, None]], -1)

    starts, ends = [], []
    for side in (1.0, -1.0):
        wave, lifted = side * jnp.sin(people.phase), jnp.maximum(side * jnp.cos(people.phase), 0.0)
        starts.append(at(FOOT, side * APART, swing * wave, LIFT * tall * lifted * jnp.minimum(speed, 1.0)))
        ends.append(at(HIP, side * APART))
    for low, high in (TRUNK, HEAD):
        starts.append(at(low))
        ends.append(at(high))
    return jnp.stack(starts, 1), jnp.stack(ends, 1)


def as_rounds(start: jax.Array, end: jax.Array, people: People, colour: jax.Array) -> Rounds:
    """The capsules of N people, person after person, from the ends of their axes (N, PARTS, 3)."""
    along = end - start
    length = jnp.sqrt(jnp.sum(along**2, -1) + 1e-12)
    radius = people.height[:, None] * jnp.array(RADII)
    there = jnp.broadcast_to(people.there[:, None], radius.shape)

    def flat(leaf):
        return leaf.reshape(-1, *leaf.shape[2:])

    return Rounds(
        centre=flat((start + end) / 2),
        axis=flat(along / length[..., None]),
        half=flat(length / 2),
        radius=flat(radius),
        capsule=jnp.ones(radius.size, bool),
        colour=colour,
        mask=flat(there),
    )


def dressed(key: jax.Array, count: int) -> jax.Array:
    """(N * PARTS, 3) colours of everybody's capsules, at random."""

    def choose(key, colours):
        return jnp.array(colours)[jax.random.randint(key, (count,), 0, len(colours))]

    trousers, shirt, skin = (
        choose(one, colours)
        for one, colours in zip(jax.random.split(key, 3), (TROUSERS, SHIRTS, SKIN), strict=True)
    )
    return jnp.stack([trousers, trousers, shirt, skin], 1).reshape(-1, 3)


def added(solids: Solids | None, people: People, key: jax.Array) -> Solids:
    """The solids of a scene with people behind all other rounds."""
    solids = solids or Solids()
    rounds = as_rounds(*skeleton(people), people, dressed(key, people.speed.shape[0]))
    if solids.rounds is not None:
        rounds = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), solids.rounds, rounds)
    return dataclasses.replace(solids, rounds=rounds)


def removed(solids: Solids, people: People) -> Solids:
    """The solids of a scene without its people."""
    assert solids.rounds is not None
    rest = solids.rounds.mask.shape[0] - people.speed.shape[0] * PARTS
    rounds = jax.tree.map(lambda leaf: leaf[:rest], solids.rounds) if rest else None
    return dataclasses.replace(solids, rounds=rounds)


def own_rounds(solids: Solids, people: People) -> Rounds:
    """The capsules of a scene's people."""
    rest = solids.rounds.mask.shape[0] - people.speed.shape[0] * PARTS  # type: ignore[union-attr]
    return jax.tree.map(lambda leaf: leaf[rest:], solids.rounds)


def ends_of(rounds: Rounds) -> tuple[jax.Array, jax.Array]:
    """Both ends (N, PARTS, 3) [m] of the axes of people's capsules, as they are drawn."""
    reach = rounds.half[:, None] * rounds.axis
    return (rounds.centre - reach).reshape(-1, PARTS, 3), (rounds.centre + reach).reshape(-1, PARTS, 3)


def moved(solids: Solids, people: People, start: jax.Array, end: jax.Array) -> Solids:
    """The solids with the capsules of people elsewhere: the ends of their axes are (N, PARTS, 3)."""
    old = own_rounds(solids, people)
    new = as_rounds(start, end, people, old.colour)
    if solids.rounds.mask.shape[0] > new.mask.shape[0]:  # type: ignore[union-attr]
        rest = removed(solids, people).rounds
        new = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), rest, new)
    return dataclasses.replace(solids, rounds=new)
