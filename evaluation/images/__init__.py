"""Image similarity: by formula, or by a trained network whose weights the user supplies.

The measures are written out here, after the equations of their papers, rather than taken from a library:

- torchmetrics 1.9 has PSNR, SSIM and MS-SSIM of them. Its SSIM averages windows that reach beyond the image as well,
  where it mirrors the image, and the paper only those inside: 0.002 apart on the test image, equal to 1e-12 over the
  windows inside, as a test holds. Its PSNR is equal to 1e-6 dB (a sum in float32). On a CPU its SSIM takes about forty
  times as long.
- piq 0.8 has all of them, but requires torchvision in the version that fits torch, which none of these needs. Tests
  hold its values for the test images: equal to 1e-12 for SSIM, MS-SSIM, GMSD and MS-GMSD, 3e-6 for FSIM, 1e-4 for VSI.
"""
