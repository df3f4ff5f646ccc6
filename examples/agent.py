"""An agent of one's own as a policy file: it turns towards the blue marker, and `whill_mjx.evaluate` drives it."""

import jax.numpy as jnp

from dreamer import PolicyContract, export_policy


def step(carry, image):
    """One decision of one instance: (carry, image (64, 64, 3) uint8) -> (carry, action (2,) in [-1, 1])."""
    red, green, blue = jnp.moveaxis(image.astype(jnp.float32), -1, 0)
    seen = jnp.clip(blue - (red + green) / 2 - 60.0, 0.0).sum(axis=0)  # (64,) how blue each column is
    columns = jnp.linspace(-1.0, 1.0, 64)
    turn = jnp.clip(-3.0 * (seen * columns).sum() / (seen.sum() + 1.0), -1.0, 1.0)  # left is positive
    return {"steps": carry["steps"] + 1.0}, jnp.stack([jnp.float32(0.2), turn])


def main() -> None:
    contract = PolicyContract(action_low=(0.0, -1.0), action_high=(1.0, 1.0), action_repeat=2, task="obstacle_course")
    nothing_learned = {"none": jnp.zeros(1)}
    folder = export_policy("runs/marker/policy", step, {"steps": jnp.zeros(1)}, nothing_learned, contract)
    print(f"{folder}: python -m whill_mjx.evaluate {folder} --set gates=0 --episodes 20 --out runs/marker/evaluation")


if __name__ == "__main__":
    main()
