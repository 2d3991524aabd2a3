"""A scene as Mitsuba 3 sees it: two sets of shapes, what is solid and the surface of the water."""

from __future__ import annotations

from types import ModuleType

import numpy as np

from fields.device import choose_device
from refract import FlatWater
from refract.surfaces import WaterSurface
from survey.errors import SurveyError
from survey.simulate.ground import Ground, Shape
from survey.simulate.skin import ImageSkin, VertexSkin

# The plane of the water reaches this far beyond what is solid, as a share of its extent: light comes from there.
_BEYOND = 0.5
_VARIANTS = {"cuda": "cuda_ad_rgb", "llvm": "llvm_ad_rgb", "torch": "scalar_rgb"}


def load_mitsuba(device: str = "auto") -> ModuleType:
    """Mitsuba 3 with the fastest variant that runs here: CUDA, LLVM, or the scalar one, some hundred times slower.

    Raises
    ------
    SurveyError
        If it is not installed.
    """
    # First, because it tells Dr.Jit where LLVM is.
    chosen = choose_device(device)
    try:
        import mitsuba
    except ImportError as error:
        raise SurveyError(
            "render.mode is physical, which takes Mitsuba 3: pip install 'bathynerf[simulate]'; or give "
            "--mode direct, which needs no more than what is there"
        ) from error
    mitsuba.set_variant(_VARIANTS[chosen.name])
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba


def solid_scene(mi: ModuleType, ground: Ground):
    """All that is solid, matt and with its albedo, as a Mitsuba scene."""
    shapes = (ground.bed, *ground.solids)
    parts = {
        f"shape_{i}": _matt(mi, f"shape_{i}", shape, look.skin)
        for i, (shape, look) in enumerate(_pairs(shapes, ground))
    }
    return mi.load_dict({"type": "scene", **parts})


def water_scene(mi: ModuleType, water: WaterSurface, ground: Ground):
    """The surface of the water, as a Mitsuba scene of its own."""
    vertices, _, _ = ground.bed.mesh()
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    margin = _BEYOND * (high - low)
    if not isinstance(water, FlatWater):
        raise SurveyError("only still water can be rendered in the physical mode")
    (x0, y0), (x1, y1) = low - margin, high + margin
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    points = np.concatenate([corners, water.height(corners[:, 0], corners[:, 1])[:, None]], axis=-1)
    bsdf = {"type": "dielectric", "int_ior": float(water.n_water), "ext_ior": 1.0}
    mesh = _mesh(mi, "water", points, np.array([[0, 1, 2], [0, 2, 3]]), bsdf)
    return mi.load_dict({"type": "scene", "water": mesh})


def _pairs(shapes: tuple[Shape, ...], ground: Ground):
    return zip(shapes, ground.looks, strict=True)


def _matt(mi: ModuleType, name: str, shape: Shape, skin: ImageSkin | VertexSkin):
    """One body: corners of its triangles carry texel coordinates, or its vertices colours."""
    vertices, faces, of_hit = shape.mesh()
    if isinstance(skin, VertexSkin):
        bsdf = _two_sided({"type": "mesh_attribute", "name": "vertex_color"})
        return _mesh(mi, name, vertices, faces, bsdf, colours=skin.colours)
    rows, columns = skin.image.shape[:2]
    bitmap = {
        "type": "bitmap",
        "data": mi.TensorXf(np.clip(skin.image, 0.0, 1.0).astype(np.float32)),
        "raw": True,
        "wrap_mode": "repeat" if skin.repeats else "clamp",
        "filter_type": "nearest" if skin.sharp else "bilinear",
    }
    if len(skin.texel_from_point) > 1:
        # Neighbours are laid out differently: no vertex is shared.
        of_hit, vertices = np.repeat(of_hit, 3), vertices[faces.ravel()]
        faces = np.arange(len(vertices)).reshape(-1, 3)
        texels = skin.texels(vertices, of_hit)
    else:
        texels = skin.texels(vertices, np.zeros(len(vertices), dtype=np.int64))
    # Mitsuba counts from the border of the first texel, as a share of the image.
    uv = (texels + 0.5) / (columns, rows)
    return _mesh(mi, name, vertices, faces, _two_sided(bitmap), uv=uv)


def _two_sided(texture: dict) -> dict:
    return {"type": "twosided", "matt": {"type": "diffuse", "reflectance": texture}}


def _mesh(mi: ModuleType, name: str, vertices, faces, bsdf: dict, *, uv=None, colours=None):
    """A Mitsuba mesh without normals of its own: faces are flat."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_texcoords=uv is not None, props=properties)
    if colours is not None:
        mesh.add_attribute("vertex_color", 3, np.ascontiguousarray(colours, dtype=np.float32).ravel())
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
    params["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
    if uv is not None:
        params["vertex_texcoords"] = np.ascontiguousarray(uv, dtype=np.float32).ravel()
    params.update()
    return mesh
