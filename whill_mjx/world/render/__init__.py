"""The camera: scene and camera pose of one instance -> image, depth, labels and normals.

    camera      intrinsics, lens distortion, poses, the ray of each pixel
    visibility  ray against box, block, cylinder, capsule; shadow rays
    tables      numbers of all primitives of one image
    shading     colour of what a ray meets: light, shadow, texture, fog, anti-aliasing
    culling     which primitives a part of the image can show
    image       the renderer in jnp
    blocks      loops over images on a processor
    pallas      the same as a GPU kernel
    draw        the one of the two that suits the device
"""

from whill_mjx.world.render.camera import Intrinsics, camera_rotation, look_at, pinhole
from whill_mjx.world.render.image import Frame, render, render_frame
from whill_mjx.world.render.shading import Quality
from whill_mjx.world.render.visibility import FIRST_BOX, GROUND, MARKER, SKY

__all__ = [
    "FIRST_BOX",
    "GROUND",
    "MARKER",
    "SKY",
    "Frame",
    "Intrinsics",
    "Quality",
    "camera_rotation",
    "look_at",
    "pinhole",
    "render",
    "render_frame",
]
