"""A cart with lags as the text of a Python file, for fits of models that are functions."""

TEXT = '''
import jax.numpy as jnp
from sysid.replay.models import function_model

def step(p, state, command):
    x, y, yaw, v, omega = state
    v = v + 0.02 * (command[0] - v) / p["LAG_V"]
    omega = omega + 0.02 * (command[1] - omega) / p["LAG_OMEGA"]
    yaw = yaw + 0.02 * p["turn"] * omega
    return jnp.stack([x + 0.02 * v * jnp.cos(yaw), y + 0.02 * v * jnp.sin(yaw), yaw, v, omega])

model = function_model(step, PARAMETERS, dt=0.02)
'''


def cart(lag_v: str, lag_omega: str, parameters: str) -> str:
    """The file, with the names of the two lags and the table of parameters as text."""
    return TEXT.replace("LAG_V", lag_v).replace("LAG_OMEGA", lag_omega).replace("PARAMETERS", parameters)
