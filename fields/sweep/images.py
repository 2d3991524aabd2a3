"""Images (height, width) between the kernels, on the host or on the device: two modules with the same functions."""

from __future__ import annotations

from types import ModuleType

from fields.device import Device


def image_backend(device: Device) -> ModuleType:
    """Functions on the images of a device: `fields.sweep.images_host`, which says what each does, or its counterpart.

    Only the one that a device needs is imported: that of devices with memory of their own, or that of the host.
    """
    if device.has_own_memory:
        from fields.sweep import images_device

        return images_device
    from fields.sweep import images_host

    return images_host
