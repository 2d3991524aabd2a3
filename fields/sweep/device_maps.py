"""Height maps in the memory of a device between the passes; those that do not fit stay on the host."""

from __future__ import annotations

from collections.abc import Iterator, MutableMapping

from fields.device import Device, memory_bytes
from fields.sweep.images import images
from fields.sweep.maps import HeightMap, Keep, Maps

# Share of the memory of a device that maps may take; a pixel of a map takes four float32.
_SHARE, _PIXEL_BYTES = 0.5, 16


def device_map_store(device: Device, keep: Keep, room_bytes: int | None = None) -> Keep:
    """Factory of map stores for the kernels of a device; ``keep`` is that of stores on the host.

    Maps on the device take ``room_bytes``, by default half of its memory.
    """
    if not device.apart:
        return keep
    room = _Budget(int(_SHARE * memory_bytes(device)) if room_bytes is None else room_bytes)
    return lambda: DeviceMaps(device, keep(), room)


def to_host_maps(device: Device, maps: Maps, keep: Keep) -> Maps:
    """Maps moved to the memory of the host; the store on the device is emptied."""
    if not device.apart:
        return maps
    found = keep()
    for view in list(maps):
        found[view] = images(device).download(maps.pop(view))
    return found


class _Budget:
    """Memory budget in bytes that several stores share."""

    def __init__(self, num_bytes: int):
        self.left = num_bytes


class DeviceMaps(MutableMapping[int, HeightMap]):
    """Maps by view, on the device while there is room, the others on the host.

    Parameters
    ----------
    device : Device
    on_host : store of the maps that do not fit
    room : _Budget
    """

    def __init__(self, device: Device, on_host: Maps, room: _Budget):
        self._device, self._on_host, self._budget = device, on_host, room
        self._held: dict[int, HeightMap] = {}

    def __getitem__(self, view: int) -> HeightMap:
        if view in self._held:
            return self._held[view]
        return images(self._device).upload(self._device, self._on_host[view])

    def __setitem__(self, view: int, m: HeightMap) -> None:
        self.pop(view, None)
        if _bytes_of(m) <= self._budget.left:
            self._budget.left -= _bytes_of(m)
            self._held[view] = m
        else:
            self._on_host[view] = images(self._device).download(m)

    def __delitem__(self, view: int) -> None:
        if view in self._held:
            self._budget.left += _bytes_of(self._held.pop(view))
        else:
            del self._on_host[view]

    def __iter__(self) -> Iterator[int]:
        return iter(sorted({*self._held, *self._on_host}))

    def __len__(self) -> int:
        return len(self._held) + len(self._on_host)

    def __contains__(self, view: object) -> bool:
        return view in self._held or view in self._on_host


def _bytes_of(m: HeightMap) -> int:
    rows, columns = m.height.shape
    return _PIXEL_BYTES * rows * columns
