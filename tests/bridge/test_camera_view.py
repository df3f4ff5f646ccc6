"""What a policy sees of a camera whose lens is calibrated."""


import numpy as np
import pytest

from bridge.policy import SensorInput
from bridge.sensing.image import ImageError, RawImage, area_resize
from bridge.sensing.view import Calibration, Rectifier, read_calibration, view_of

pytestmark = pytest.mark.quick

FOV = 1.2
LENSES = {"plumb_bob": (-0.3, 0.1, 0.001, -0.002, 0.01), "equidistant": (0.01, 0.02, -0.01, 0.003),
          "rational_polynomial": (-0.3, 0.1, 0.001, -0.002, 0.01, 0.02, 0.03, 0.01)}
YAML = """image_width: 640
image_height: 480
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [300, 0, 321, 0, 310, 238, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.3, 0.1, 0.001, -0.002, 0.01]}
"""


def ideal(height, width, fov=FOV):
    focal = height / 2 / np.tan(fov / 2)
    return Calibration(width, height, (focal, focal, width / 2 - 0.5, height / 2 - 0.5), "plumb_bob", (0.0,) * 5)


def contract(**camera):
    return SensorInput("image", "camera", (64, 64, 3), camera=camera)


@pytest.mark.parametrize("size", [(64, 64), (320, 320), (640, 640)])
def test_view_of_the_training_camera_itself_is_the_area_average_bit_for_bit(size):
    image = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    assert np.array_equal(Rectifier(ideal(*size), FOV, (64, 64))(image), area_resize(image, (64, 64)))


@pytest.mark.parametrize("model", list(LENSES))
def test_lenses_bend_light_as_opencv_says(model):
    cv2 = pytest.importorskip("cv2")
    lens = Calibration(640, 480, (400.0, 410.0, 321.0, 238.0), model, LENSES[model])
    x, y = (one.ravel() for one in np.meshgrid(np.linspace(-0.6, 0.6, 7), np.linspace(-0.5, 0.5, 5)))
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    matrix = np.array([[400.0, 0, 321], [0, 410, 238], [0, 0, 1]])
    points = np.stack([x, y, np.ones_like(x)], -1)[:, None]
    want, _ = project(points, np.zeros(3), np.zeros(3), matrix, np.array(LENSES[model]))
    np.testing.assert_allclose(np.stack(lens.project(x, y), -1), want.reshape(-1, 2), atol=1e-9)


def test_what_a_bent_lens_saw_becomes_what_the_training_saw():
    """A smooth picture of directions, seen through a lens, is the same picture of directions afterwards."""
    lens = Calibration(640, 480, (300.0, 310.0, 321.0, 238.0), "plumb_bob", LENSES["plumb_bob"])
    focal = 32 / np.tan(FOV / 2)
    across, down = np.meshgrid(*[(np.arange(64) - 31.5) / focal] * 2)
    columns, rows = lens.project(across, down)
    marked = np.zeros((480, 640, 3), np.uint8)
    marked[..., 0], marked[..., 1] = np.arange(640)[None] / 2.6, np.arange(480)[:, None] / 1.9
    seen = Rectifier(lens, FOV, (64, 64))(marked)
    assert np.abs(seen[..., 0] - columns / 2.6).max() < 2 and np.abs(seen[..., 1] - rows / 1.9).max() < 2


def test_a_camera_that_sees_less_than_the_training_did_is_refused():
    with pytest.raises(ValueError, match=r"does not see .* % of what the training's camera saw .69 degrees high"):
        Rectifier(ideal(480, 640, fov=0.9), FOV, (64, 64))


def test_an_image_of_another_size_than_the_calibration_is_refused():
    with pytest.raises(ImageError, match="calibration is of 480 x 640"):
        Rectifier(ideal(480, 640), FOV, (64, 64))(np.zeros((240, 320, 3), np.uint8))


def test_the_view_is_chosen_by_the_options_and_what_cannot_be_served_is_refused(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(YAML)
    assert read_calibration(path).matrix == (300.0, 310.0, 321.0, 238.0)
    view = view_of(contract(fov_y=FOV), None, path)
    assert view.raw(RawImage(480, 640, "bgr8", 1920, bytes(480 * 1920))).shape == (64, 64, 3)
    for crop, about, message in [((0, 0, 9, 9), contract(fov_y=FOV), "--crop and --calibration"),
                                 (None, contract(), "does not state its camera's field of view"),
                                 (None, contract(fov_y=2.6), "camera.yaml: the camera does not see"),
                                 ((0, 0, 9, 9), SensorInput("scan", "lidar", (36,)), "the policy reads none")]:
        with pytest.raises(ValueError, match=message):
            view_of(about, crop, path)
