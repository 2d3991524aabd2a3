"""A block of pycolmap with known truth, without images."""

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation


def synthetic_block(
    rng: np.random.Generator, *, focal=900.0, tilt_deg=0.0, first=0, at=(0.0, 0.0)
) -> tuple[pycolmap.Reconstruction, dict[str, np.ndarray]]:
    """A block of three strips of six nadir views, 40 m over rolling ground, at its true place; and true centres.

    ``tilt_deg`` turns views by turns left and right; ``first`` is the number in the name of the first, and ``at`` the
    middle of the block [m].
    """
    size, half = (800, 600), (400.0, 300.0)
    block = pycolmap.Reconstruction()
    block.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="RADIAL", width=size[0], height=size[1], params=[focal, *half, 0.0, 0.0])
    )
    ground = np.column_stack([rng.uniform(-45.0, 45.0, (600, 2)) + at, np.zeros(600)])
    ground[:, 2] = 2.0 * np.sin(ground[:, 0] / 9.0) * np.cos(ground[:, 1] / 7.0)
    seen_in, centres = [[] for _ in ground], {}
    for i, (x, y) in enumerate((x, y) for y in (-20.0, 0.0, 20.0) for x in np.linspace(-25.0, 25.0, 6)):
        name, centre = f"{first + i:02d}.jpg", np.array([x + at[0], y + at[1], 40.0]) + rng.normal(0.0, 0.2, 3)
        rotation = Rotation.from_euler("xy", [180.0, tilt_deg * (-1) ** i], degrees=True).as_matrix()
        rays = (ground - centre) @ rotation.T
        rays = rays[:, :2] / rays[:, 2:]
        pixels = focal * rays + half
        inside = np.flatnonzero(((pixels > 0.0) & (pixels < size)).all(axis=1))
        cam_from_local = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
        image = pycolmap.Image(name=name, keypoints=pixels[inside], camera_id=1, image_id=i + 1)
        block.add_image_with_trivial_frame(image, cam_from_local)
        for place, point in enumerate(inside):
            seen_in[point].append(pycolmap.TrackElement(i + 1, place))
        centres[name] = centre
    for xyz, elements in zip(ground, seen_in, strict=True):
        if len(elements) > 2:
            block.add_point3D(xyz, pycolmap.Track(elements))
    block.update_point_3d_errors()
    return block, centres
