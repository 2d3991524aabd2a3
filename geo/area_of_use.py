"""Areas of use of CRSs, national height systems at a place, and the approximate geoid undulation there.

The undulation needs no grid to install. It serves to recognise which vertical datums were mixed up, where heights
differ by tens of metres; nothing is transformed with it. It is EGM96 (National Geospatial-Intelligence Agency, public
domain) at every fifth degree, in whole metres: interpolated, it is within 2 m (rms) of the model, and within 8 m over
99 % of the Earth.
"""

from __future__ import annotations

import base64
import zlib
from functools import cache

import numpy as np
from pyproj import CRS, Geod
from pyproj.aoi import AreaOfInterest
from pyproj.crs import CompoundCRS
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import ProjError
from pyproj.transformer import AreaOfInterest as OperationArea

from geo.crs import (
    AREA_MARGIN_DEG,
    degrees_outside_area,
    geodetic_crs,
    horizontal_crs,
    middle_lon_lat,
    prime_meridian_rad,
)
from geo.errors import GeoError, PlaceMismatch
from geo.operations import operations
from geo.transformation import lon_lat, middle_of

# Areas wider than this are worldwide: mean sea level and its models, tides.
_WORLDWIDE_DEG = 350.0
_MARGIN_DEG = 0.01


def require_in_area(crs: CRS, points: np.ndarray, subject: str, where: str = "crs") -> None:
    """Raise PlaceMismatch where the middle of points (N, 2 or 3) lies far outside the area of use of their CRS.

    The error names ``subject`` as what lies outside, and ``where`` as what to correct.
    """
    middle = middle_of(horizontal_crs(crs), np.asarray(points, dtype=np.float64))
    if middle is not None:
        _require_in_area(crs, np.radians(middle), subject, where)


def require_at(crs: CRS, lon_lat_deg: np.ndarray, subject: str, where: str) -> None:
    """Raise PlaceMismatch as `require_in_area`, for longitudes and latitudes (N, 2) of WGS 84 [deg]."""
    if len(lon_lat_deg):
        east, north = middle_lon_lat(lon_lat_deg).tolist()
        lon, lat = np.radians([east, north])
        subject += f" (about latitude {north:.3f}, longitude {east:.3f})"
        _require_in_area(crs, np.array([lon - prime_meridian_rad(crs), lat]), subject, where)


def _require_in_area(crs: CRS, middle: np.ndarray, subject: str, where: str) -> None:
    lon, lat = middle.tolist()
    excess = degrees_outside_area(crs, lon, lat)
    if excess > AREA_MARGIN_DEG:
        raise PlaceMismatch(
            f"{subject} lie {excess:.0f} degrees outside the area that {crs.name} is made for; choose the CRS of the "
            f"place ({where})"
        )


@cache
def height_systems_at(lat_deg: float, lon_deg: float) -> tuple[CRS, ...]:
    """National vertical CRSs in metres at a place, the smallest area of use first.

    Only those whose geoid PROJ knows (its grid need not be installed), and of each area the newest (the highest EPSG
    code): systems that were replaced keep their areas. PROJ has areas as rectangles, so near a border those of the
    neighbours are among them, and only a single one is certain.
    """
    margin = _MARGIN_DEG
    box = lon_deg - margin, lat_deg - margin, lon_deg + margin, lat_deg + margin
    newest: dict[tuple[float, ...], tuple[float, int]] = {}
    for info in query_crs_info("EPSG", PJType.VERTICAL_CRS, AreaOfInterest(*box), contains=True):
        use, code = info.area_of_use, int(info.code)
        width = _WORLDWIDE_DEG if use is None else (use.east - use.west) % 360.0 or 360.0
        if use is None or width >= _WORLDWIDE_DEG or not _is_national(code, OperationArea(*box)):
            continue
        newest[use.bounds] = max(newest.get(use.bounds, (0.0, 0)), (width * (use.north - use.south), code))
    # The code decides between areas of equal size.
    return tuple(CRS.from_epsg(code) for _, code in sorted(newest.values()))


def likely_crs(points: np.ndarray, lon_lat_deg: tuple[float, float], within_m: float, like: CRS) -> list[CRS]:
    """Projected CRSs in use at a place in which points (N, 2 or 3) lie about it: the datum of ``like`` first.

    Codes that EPSG withdrew are left out; the median of the distances to the place is at most ``within_m``.
    """
    lon, lat = lon_lat_deg
    box = lon - _MARGIN_DEG, lat - _MARGIN_DEG, lon + _MARGIN_DEG, lat + _MARGIN_DEG
    found = []
    for info in query_crs_info("EPSG", PJType.PROJECTED_CRS, AreaOfInterest(*box), contains=True):
        crs = CRS.from_epsg(int(info.code))
        try:
            east, north = lon_lat(crs, points[:, :2]).T
        except (GeoError, ProjError):
            continue
        finite = np.isfinite(east) & np.isfinite(north) & (np.abs(north) <= 90.0)
        if not finite.any():
            continue
        away = Geod(ellps="WGS84").inv(
            east[finite], north[finite], *np.broadcast_to([[lon], [lat]], (2, finite.sum()))
        )[2]
        away_m = float(np.median(away))
        if away_m <= within_m:
            # Of a grid with its axes swapped, only the name differs here.
            is_other = geodetic_crs(crs) != geodetic_crs(like) or "(N-E)" in crs.name
            found.append((is_other, round(away_m, -2), int(info.code), crs))
    return [crs for *_, crs in sorted(found, key=lambda item: item[:3])]


def _is_national(code: int, area: OperationArea) -> bool:
    """Whether a vertical CRS counts metres upwards from a geoid that PROJ knows at the place."""
    vertical = CRS.from_epsg(code)
    axis = vertical.axis_info[0]
    if axis.direction != "up" or axis.unit_conversion_factor != 1.0:
        return False
    compound = CompoundCRS(f"WGS 84 + {vertical.name}", ["EPSG:4326", vertical])
    try:
        group = operations("EPSG:4979", compound, area)
    except ProjError:
        return False
    steps = [transformer.definition for transformer in group.transformers]
    steps += [operation.to_proj4() for operation in group.unavailable_operations]
    return any("vgridshift" in text for text in steps)


_STEP_DEG = 5.0
_ROWS, _COLUMNS = 37, 72
# From 90 degrees south and 180 degrees west: int8, packed by zlib, in base 85.
_PACKED = (
    "c-pO2S#R6u6(vQ9izsdqwac<3?~4>C_SlIXkCW+a4{aa%;|dfl(4s|W+J~UPV2YwZXFAR{Nyd&>$yzLm+V`ClMT(;OIsFTBNf6)z?{|6bz2}@l;pd4"
    "=GIf(k#BY-6bVd+_La|&a7E0Ad6-2w+?sR*-Ucc8H42JSZ8Qp~}4SJncqgE-"
    "3LiYAH1FqY2_9qZ0Kb^imzf9bu(wQ7c(WurN&1R$3?R2~Sp)^v|$#e!IW|P^1;<&|vnqgx+Xx9ot>gM|F{rl5*C#R>+kB^UkIDY=_{5p}o%@)elX"
    "1m*$G;p+{>QiGjGh0c5q!^ZCSq9t`Mc^1}n#kR1{x%gqKYjc9^_$nPUOfj%UcCJA?a9S;GLy~aE7hhn(#@0whD?YFHkr%>Ni#IZIzjmTeqVs&SPD"
    "n9VW(CUGl}cdw{PD3`05oX>HXQoWjt|{&WZq-daEyM5X#sc6irh$D?xxf9LGBxPLD4T3<mrjo~1BkrgU4yTsC!mb$NY#@&4rUDxS;;Vjciot<~$T"
    "?m$*`6T$I3&$`?mtJA?T499!C{<%;j5)Oyw=loudK&InCt6IwEa`{3&o4mdd1QCEzZ?rm{{t$#b(xxVavVpHz)`>H`%L9JK;}1m^RyH@+R+bhP!d"
    "?f3L7LP7O|8|Nje4bA$aUN8PN&oBbvr!?^c0{wg)9_F+Hezspd`zC{eG|48w@WjuSKKLjpfzVu%D+;L+Q8bwMMJm?RE#!NJ1b@8IPr5zdw-"
    "V4^5gO7{%ELXgZx37~}H!JWiJ{5DG^&W3lM^Vrbs)WN-"
    "jay<9HWTA;b$XdHD?C;}VmNE!~M53>SB1+%&t+A`Ht1ErlFH_!3jz#PD4d1G~9&gZs+YNTc<CkXj+vu_wCi_Jj=yqwhn>En?s%b=jKrW-Iu1$mBw"
    "G<AyEI0t991DHcT-<&TzA9Ohxt6A&U#AGU)&6Q-"
    ">$}<jMXnAYiO{4HkQ>44W|Bwd3nI(^%L{tSrP%F)FPPZ=<2?crDK{JdMg_KTJOsA5?dS?JpuFza~aWncL;H7cXRFy#*buyV6kjad5i*ruYtjX#Gj"
    "5EdZK2Ip%agqoQ!w@tX)Wmc=krq0Nj!?cxY-4Ndqn!skK87%ZdSqGArp8nU_~2}0oi~qFb*yPK%to;ex6egk`bd-Ik<=8E7w6}f*@|SQJ>l5iqrF"
    "E5PY&;|`)C4%r|SO~YND#z6bs(-"
    "v4%2~WmSVPlA>tVMVZG^tI}`O@;4_xzIc6>EDdH%Xk}~n>Cw@XgQxoopo=7CnN7iJ0+<y^R`i+QZ%0P$o+OPl@Lv>Zr8sml?3Z(*kUo9!uW$eT-"
    ";1(lkc;7+qtCwh^%qC`+iM;N$I&(`3QtCZJDM2`Mh3_5=(ts@N&p{>v2z@OnnvAzy8w9V-S^*o^_OQqB-"
    "&J9WB1|Sr@#FCH%|`kt;{>^cMCw_usUpm_38{{9j1BO7*;Fw_Sj^l91aJ^60>f5)GNo&PLBWi^&fus^|7GRk=_06Uw!%IXGaJ3*Fs*FvC%9|Ao{R"
    "XDHJO0p*lk;x1qF!+k8g{^TYdnypt!ufDN0%*}Lc8{Q394{pw|6h`2XDe)9RJpB(M&L?ZzgWwn8kfOWZ9yiH|_EolN<;fY*IT*bwnijZ6|9B{i`l"
    "xa56M=kO6^|ych<DdR^d|6e<(9Y9?$A^2-wS|D!LEyO60_&r0<u-"
    "A3BR1uc3DG)*<lD1!r8~iS_k1wma`Lp5FoUUY3h%!A$Fsjb`{BLNoZ8pcw;t^5Z7$5YS)18H5V%e4*Yl~X^SIDd+j75MzBs;!=Q<-"
    "3=k`W|{&~Njr)etyJD-WaeevCYj$fW;N<)h?yu5z@-"
    "dey#6P782nGpl9ZSLmsBA#vb#B#Y5KRG?Ssf=O5?wXG*2mOF@Tnr#b19U!ddGhl4yVI1|)R{ndDYhJNSdp1NRwrP$dd-rMj3=^%TD@2<ikBx>H@O"
    "bXdV|5p>PBn<5US6~a#p>g^~<TtY)MFqiJFYLgNy4y2Z`wF2g2xg8|7R&c_S2RjgnZ(i}9;ezCI@WYnvNuv5n0KOG^<qk2!c0Rk{taRLv$6$&}bL"
    "^TEZ4o3R**G#W~>JnS_q`D{k01KF#JfLDa9Q0~KQD0Z;Fvvq%WI~t2cR#zf(e6L@+y~)1${<~LiuZl9lxr56bhZ<v9(k9cXJ_aIEu9VvYfOlEQX2"
    "eRPZ*YN??Zc;skG7-"
    "twpU`COY<%YmRrS4;v#wc>Zh}7u@8~%xqy$hS*BA}n^_3V0!<{Kp1naAsAM*oysgxSxF;0d{rKqPNBbW|?`=g_Lw=Toq;9*IOJBtkmx*MdJs}vU%"
    "fWk43j%{Q06-"
    "Fj095^UwU|o+LCREmW6Hbo;PK<b!~Ole*xG8u?{TmsYSKonO71q3PA7#zM}Y{iQx2yKwipmf*ci}L5`)xUEq|Lhzqm>i>SGHxw|4*GlcU4Od%K{T"
    "IftEPNx+4AA7Cj8IU!%FbT!xlwu+@G!mwD(7-"
    "1!CByN&>4bXj{&SG_Fu)grt=EH+0zxd?wN86jLA+O!eQ8)_CMuSePS+CX_cV0w?%mju52Y@0F49%b!Ai}ZS?^H{rN~O^mBUX1HxDwlawEy_v;r9L"
    "L`f||21D--"
    "=Q&kxa2g5;ssK^S?%o$`dA!f4~JRxJE>#CxUBzgEjl~LMmcX&e!OKZ{CooE3aU7hziIU8;^!PAMRs;Z(W+C(>u83e<?Oduw+8Mq1v6l4IC0z3|al"
    "Q=_Rq}>ykk1Q>QL-"
    "Rn^fffh-9+#b^NCE?AgD*`cXg0gM?_3FZ#|grE7bK8kK*Tg?0B3jbPM6E+ba^~ppU?XtJRY}`ci1_W0XBrP*=!^Uya<jF1csp~hS5J${0|n!AB+"
)


def approximate_undulation_m(lat_deg: float, lon_deg: float) -> float:
    """Approximate height of the geoid over the WGS 84 ellipsoid at a place [m]; negative where it lies below.

    Examples
    --------
    In Denmark about 40 m, and south of India, where it is lowest, -106 m.

    >>> round(approximate_undulation_m(55.0, 10.0)), round(approximate_undulation_m(5.0, 80.0))
    (40, -106)
    """
    packed = zlib.decompress(base64.b85decode(_PACKED))
    grid = np.frombuffer(packed, dtype=np.int8).reshape(_ROWS, _COLUMNS).astype(np.float64)
    row = min(max((lat_deg + 90.0) / _STEP_DEG, 0.0), _ROWS - 1.0)
    column = (lon_deg + 180.0) % 360.0 / _STEP_DEG
    south, west = min(int(row), _ROWS - 2), int(column) % _COLUMNS
    up, right = row - south, column - int(column)
    corners = grid[south : south + 2, [west, (west + 1) % _COLUMNS]]
    return float(np.array([1.0 - up, up]) @ corners @ np.array([1.0 - right, right]))
