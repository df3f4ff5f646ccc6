"""The cart-pole of the benchmark against MuJoCo, and against the suite it follows where that is installed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import cartpole_env as cp

MODEL = f"""
<mujoco>
  <option timestep="0.01" integrator="RK4"><flag contact="disable"/></option>
  <worldbody>
    <body name="cart" pos="0 0 1">
      <joint name="slider" type="slide" limited="true" axis="1 0 0" range="-1.8 1.8" solreflimit=".08 1"
             damping="5e-4"/>
      <geom type="box" size="0.2 0.15 0.1" mass="1"/>
      <body>
        <joint type="hinge" axis="0 1 0" damping="2e-6"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size="{cp.RADIUS}" mass=".1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slider" gear="10" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@jax.jit
def drive(position, velocity, actions):
    def one(state, action):
        state = cp.advance(*state, action)
        return state, (*state, cp.smooth_reward(*state, action))

    return jax.lax.scan(one, (position, velocity), actions)[1]


def pushes(steps, seed, held=20):
    """Full and random pushes to either side, each held for some steps, so that the cart also hits the rail's ends."""
    rng = np.random.default_rng(seed)
    return np.repeat(np.clip(rng.normal(size=-(-steps // held)) * 2, -1, 1), held)[:steps].astype(np.float32)


@pytest.mark.parametrize("angle, push", [(0.03, 0), (np.pi - 0.01, 0), (0.5, 1.0), (0.5, -1.0)])
def test_the_cart_and_the_pole_move_as_in_mujoco_also_against_the_ends_of_the_rail(angle, push):
    import mujoco

    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (0.1, angle), (0.02, -0.01)
    actions = pushes(150, 0) if push == 0 else np.full(150, push, np.float32)
    expected = []
    for action in actions:
        data.ctrl[:] = action
        mujoco.mj_step(model, data)
        expected.append([*data.qpos, *data.qvel])
    expected = np.array(expected)
    position, velocity, _ = drive(jnp.array([0.1, angle]), jnp.array([0.02, -0.01]), jnp.asarray(actions))
    np.testing.assert_allclose(np.concatenate([position, velocity], -1), expected, atol=2e-3)
    if push:
        assert np.abs(expected[:, 0]).max() > cp.RAIL  # it did hit the end


@pytest.mark.parametrize("task", ["balance", "swingup"])
def test_rewards_and_motion_are_those_of_the_control_suite(task):
    suite = pytest.importorskip("dm_control.suite", reason="dm_control is not installed; it is no dependency of ours")
    env = suite.load("cartpole", task, task_kwargs={"random": 3})
    env.reset()
    physics = env.physics
    position, velocity = jnp.array(physics.data.qpos), jnp.array(physics.data.qvel)
    actions = pushes(150, 1)
    steps = [env.step(np.array([action])) for action in actions]
    ours = drive(position, velocity, jnp.asarray(actions))
    np.testing.assert_allclose(ours[2], [step.reward for step in steps], atol=2e-3)
    seen = jax.vmap(cp.joint_state)(ours[0], ours[1])
    for name in ("position", "velocity"):
        np.testing.assert_allclose(seen[name], [step.observation[name] for step in steps], atol=1e-2)


@pytest.mark.quick
def test_the_reward_by_hand():
    still = (jnp.zeros(2), jnp.zeros(2), jnp.zeros(()))
    assert float(cp.smooth_reward(*still)) == 1.0
    assert float(cp.smooth_reward(jnp.zeros(2), jnp.zeros(2), jnp.ones(()))) == pytest.approx(0.8)
    assert float(cp.smooth_reward(jnp.array([2.0, 0.0]), jnp.zeros(2), jnp.zeros(()))) == pytest.approx(0.55)
    assert float(cp.smooth_reward(jnp.array([0.0, np.pi / 2]), jnp.array([0.0, 5.0]), jnp.zeros(()))) == pytest.approx(
        0.5 * 0.55
    )
    assert float(cp.smooth_reward(jnp.array([0.0, np.pi]), jnp.zeros(2), jnp.zeros(()))) == pytest.approx(0.0, abs=1e-6)


def test_an_episode_is_a_thousand_steps_ends_by_time_out_and_begins_anew():
    env = cp.make("balance", 2, "joints")

    def one(state, _):
        state, transition = env.step(state, jnp.zeros((2, 1)))
        return state, transition

    state, first = jax.jit(env.reset)(jax.random.PRNGKey(0))
    assert np.all(first.is_first) and not np.any(first.is_last)
    _, steps = jax.jit(lambda s: jax.lax.scan(one, s, None, length=502))(state)
    last = np.asarray(steps.is_last)
    assert last[499].all() and last.sum() == 2 and not np.any(steps.is_terminal)
    assert np.asarray(steps.is_first)[500].all() and np.asarray(steps.is_first).sum() == 2
    np.testing.assert_array_equal(np.asarray(steps.reward)[500], 0.0)
    begun = {name: np.asarray(value)[500] for name, value in steps.obs.items()}
    assert np.all(begun["position"][:, 1] > 0.999) and np.all(np.abs(begun["position"][:, 0]) <= 0.1)
    assert np.any(begun["position"] != np.asarray(first.obs["position"]))  # another start
    assert np.asarray(steps.reward)[1:500].min() < 0.2  # left alone it falls


@pytest.mark.quick
@pytest.mark.parametrize("x, angle", [(0.0, 0.0), (0.5, np.pi / 2), (-0.4, np.pi)])
def test_the_picture_shows_cart_and_pole_where_they_are(x, angle):
    image = np.asarray(cp.picture(jnp.array([x, angle])), int)
    assert image.shape == (64, 64, 3)
    bright = image[..., 0] > 160  # pole and cart are the only red things

    def pixel(x, z):
        return int((z + cp.HALF_VIEW) / (2 * cp.HALF_VIEW) * 64), int((x + cp.HALF_VIEW) / (2 * cp.HALF_VIEW) * 64)

    tip = pixel(x + 0.9 * np.sin(angle), -0.9 * np.cos(angle))
    assert bright[tip] and bright[pixel(x, 0.0)]
    columns = np.where(bright[pixel(0, 0.07)[0]])[0]  # a row through the cart, off its middle
    assert abs(columns.mean() - (pixel(x, 0)[1])) < 2 or angle == np.pi / 2
    assert not bright[pixel(x - 0.9 * np.sin(angle), 0.9 * np.cos(angle))]


JOINTS = {"position", "velocity"}


@pytest.mark.quick
@pytest.mark.parametrize("sight, names", [("joints", JOINTS), ("both", {"image"} | JOINTS)])
def test_the_cart_may_be_seen_by_its_joints_its_picture_or_both(sight, names):
    env = cp.make("swingup", 3, sight)
    _, transition = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    assert set(transition.obs) == set(env.obs_shape) == names
