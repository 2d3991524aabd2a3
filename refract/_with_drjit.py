"""The functions of `refract._array.namespace` in Dr.Jit; imported only where Dr.Jit is already."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import drjit

dr: Any = drjit  # says nothing of its types


NAMESPACE = SimpleNamespace(
    name="drjit", sqrt=dr.sqrt, sin=dr.sin, cos=dr.cos, atan=dr.atan, exp=dr.exp, isnan=dr.isnan,
    where=dr.select, minimum=dr.minimum, maximum=dr.maximum, abs=dr.abs,
    rsqrt=dr.rsqrt, fma=dr.fma,
    double=lambda x: dr.float64_array_t(type(x))(x) if dr.is_array_v(x) else x,
    like=lambda x, other: type(other)(x),
    eps=lambda x: 2.0 * dr.epsilon(x),
    same=lambda mask: None,
    fixed=dr.detach, tracked=lambda *arrays: any(dr.is_array_v(x) and dr.grad_enabled(x) for x in arrays),
)  # fmt: skip
