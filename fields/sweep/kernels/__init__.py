"""The kernels of the sweep: refracted rays, warping, NCC and the best height, on Dr.Jit or torch."""
