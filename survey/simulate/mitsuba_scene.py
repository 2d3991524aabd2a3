"""A scene for Mitsuba 3 in two sets of shapes: solids, and the surface of the water."""

from types import ModuleType

import numpy as np

from fields.device import choose_device
from refract.curved import BicubicWater, CurvedWater, WavyWater
from refract.surfaces import WaterSurface
from survey.errors import SurveyError
from survey.simulate.ground import Ground, Shape
from survey.simulate.shapes import BedGrid
from survey.simulate.textures import ImageTexture, VertexTexture

# The plane of the water reaches this far beyond the solids, as a share of their extent: light comes from there.
_BEYOND = 0.1
# Slopes between the corners of triangles on waves err by this at most [rad]: 0.1 mm on the bed per metre of depth.
_SLOPE_ERROR = 4e-4
# Between two nodes of a measured surface: its slopes, of second order, are then good to a hundredth of their change.
_PARTS_OF_PIECE = 4
# Of the surface: some 400 bytes each.
_MOST_POINTS = 4_000_000
_VARIANTS = {"cuda": "cuda_ad_rgb", "llvm": "llvm_ad_rgb"}


def load_mitsuba(device: str = "auto") -> ModuleType:
    """Mitsuba 3 on CUDA or LLVM, as Dr.Jit runs here."""
    # First, because it sets the path of LLVM for Dr.Jit.
    variant = _VARIANTS.get(choose_device(device).name)
    try:
        import mitsuba
    except ImportError as error:
        raise SurveyError(
            "render.mode is physical, which needs Mitsuba 3: pip install 'bathynerf[simulate]'; or give "
            "--mode direct, which needs nothing else"
        ) from error
    if variant is None:
        raise SurveyError("render.mode is physical, which needs CUDA or libLLVM; install one, or give --mode direct")
    mitsuba.set_variant(variant)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba


def solid_scene(mi: ModuleType, ground: Ground):
    """The solids, matt and with their albedo, as a Mitsuba scene."""
    shapes = (ground.bed, *ground.solids)
    bodies = enumerate(zip(shapes, ground.materials, strict=True))
    parts = {f"shape_{i}": _matt(mi, f"shape_{i}", shape, material.texture) for i, (shape, material) in bodies}
    return mi.load_dict({"type": "scene", **parts})


def water_scene(mi: ModuleType, water: WaterSurface, ground: Ground):
    """The surface of the water, as a Mitsuba scene of its own.

    Waves and measured surfaces become triangles, with their true normals at the corners.
    """
    bsdf = {"type": "dielectric", "int_ior": float(water.n_water), "ext_ior": 1.0}
    vertices, _, _ = ground.bed.mesh()
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    margin = _BEYOND * (high - low)
    area, spacing = (low - margin, high + margin), np.inf
    if isinstance(water, WavyWater):
        # Of a wave of slope a k, linear interpolation over s takes off (k s)**2 / 8.
        steep = sum(abs(a) * np.hypot(*k) ** 3 for a, k in zip(water.amplitudes, water.wave_vectors, strict=True))
        spacing = np.sqrt(8.0 * _SLOPE_ERROR / steep)
    elif isinstance(water, BicubicWater):
        area = water.area
        spacing = max(water.spacing / _PARTS_OF_PIECE, float(np.sqrt(np.prod(area[1] - area[0]) / _MOST_POINTS)))
    (west, south), (wide, deep) = area[0], area[1] - area[0]
    cell = min(spacing, max(wide, deep))
    rows, columns = (int(np.ceil(size / cell)) + 1 for size in (deep, wide))
    if rows * columns > _MOST_POINTS:
        raise SurveyError(
            f"the waves need a point every {100.0 * cell:.1f} cm over {wide:.0f} x {deep:.0f} m, more than "
            f"{_MOST_POINTS}; leave out the shortest, or make the area smaller"
        )
    points, faces, _ = BedGrid(np.zeros((rows, columns)), west, south, cell).mesh()
    # Measured surfaces end at the area.
    x, y = np.minimum(points[:, :2], area[1]).T
    points = np.stack([x, y, water.height(x, y)], axis=-1)
    curved = {"vertex_normals": np.stack(water.normal(x, y), axis=-1)} if isinstance(water, CurvedWater) else {}
    return mi.load_dict({"type": "scene", "water": _mesh(mi, "water", points, faces, bsdf, **curved)})


def _matt(mi: ModuleType, name: str, shape: Shape, texture: ImageTexture | VertexTexture):
    """Matt body: corners of its triangles carry texel coordinates, or its vertices colours."""
    vertices, faces, of_hit = shape.mesh()
    reflectance: dict
    if isinstance(texture, VertexTexture):
        reflectance, attributes = {"type": "mesh_attribute", "name": "vertex_color"}, {"vertex_color": texture.colours}
    else:
        rows, columns = texture.image.shape[:2]
        reflectance = {
            "type": "bitmap",
            "data": mi.TensorXf(np.clip(texture.image, 0.0, 1.0).astype(np.float32)),
            "raw": True,
            "wrap_mode": "repeat" if texture.repeats else "clamp",
            "filter_type": "nearest" if texture.sharp else "bilinear",
        }
        if len(texture.texel_from_point) > 1:
            # Neighbours are laid out differently: no vertex is shared.
            of_hit, vertices = np.repeat(of_hit, 3), vertices[faces.ravel()]
            faces = np.arange(len(vertices)).reshape(-1, 3)
        else:
            of_hit = np.zeros(len(vertices), dtype=np.int64)
        # Mitsuba counts from the border of the first texel, as a share of the image.
        attributes = {"vertex_texcoords": (texture.texels(vertices, of_hit) + 0.5) / (columns, rows)}
    bsdf = {"type": "twosided", "matt": {"type": "diffuse", "reflectance": reflectance}}
    return _mesh(mi, name, vertices, faces, bsdf, **attributes)


def _mesh(mi: ModuleType, name: str, vertices, faces, bsdf: dict, **attributes):
    """A Mitsuba mesh with attributes of its vertices; without their normals its faces are flat."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    has = {f"has_{key}": key in attributes for key in ("vertex_normals", "vertex_texcoords")}
    mesh = mi.Mesh(name, len(vertices), len(faces), **has, props=properties)
    flat = {
        key: np.ascontiguousarray(values, dtype=np.float32).ravel()
        for key, values in {"vertex_positions": vertices, **attributes}.items()
    }
    if "vertex_color" in flat:
        mesh.add_attribute("vertex_color", 3, flat.pop("vertex_color"))
    params = mi.traverse(mesh)
    params["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
    for key, values in flat.items():
        params[key] = values
    params.update()
    return mesh
