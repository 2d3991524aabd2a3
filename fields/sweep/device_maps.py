"""Height maps that stay in the memory of a device between the passes; those it has no room for wait on the host."""

from __future__ import annotations

from collections.abc import Iterator, MutableMapping

from fields.device import Device, memory_bytes
from fields.sweep.images import images
from fields.sweep.maps import DepthMap, Keep, Maps

# Share of the memory of a device that maps may take; a pixel of a map takes four float32.
_SHARE, _PIXEL_BYTES = 0.5, 16


def kept_beside(device: Device, keep: Keep) -> Keep:
    """What makes places for maps that kernels of a device work on; ``keep`` makes those of the host."""
    if not device.apart:
        return keep
    room = _Room(int(_SHARE * memory_bytes(device)))
    return lambda: Resident(device, keep(), room)


def brought_back(device: Device, maps: Maps, keep: Keep) -> Maps:
    """Maps in the memory of the host, where they are not there yet; the others are cleared."""
    if not device.apart:
        return maps
    found = keep()
    for view in list(maps):
        found[view] = images(device).left(maps.pop(view))
    return found


class _Room:
    """Bytes that several places for maps share."""

    def __init__(self, num_bytes: int):
        self.left = num_bytes


class Resident(MutableMapping[int, DepthMap]):
    """Maps by view, on the device while there is room, the others on the host.

    Parameters
    ----------
    device : Device
    aside : place for maps of the host
    room : _Room
    """

    def __init__(self, device: Device, aside: Maps, room: _Room):
        self._device, self._aside, self._room = device, aside, room
        self._held: dict[int, DepthMap] = {}

    def __getitem__(self, view: int) -> DepthMap:
        if view in self._held:
            return self._held[view]
        return images(self._device).arrived(self._device, self._aside[view])

    def __setitem__(self, view: int, m: DepthMap) -> None:
        self.pop(view, None)
        if _bytes_of(m) <= self._room.left:
            self._room.left -= _bytes_of(m)
            self._held[view] = m
        else:
            self._aside[view] = images(self._device).left(m)

    def __delitem__(self, view: int) -> None:
        if view in self._held:
            self._room.left += _bytes_of(self._held.pop(view))
        else:
            del self._aside[view]

    def __iter__(self) -> Iterator[int]:
        return iter(sorted({*self._held, *self._aside}))

    def __len__(self) -> int:
        return len(self._held) + len(self._aside)

    def __contains__(self, view: object) -> bool:
        return view in self._held or view in self._aside


def _bytes_of(m: DepthMap) -> int:
    rows, columns = m.height.shape
    return _PIXEL_BYTES * rows * columns
