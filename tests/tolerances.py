"""All tolerances. A test that needs another one says why."""

FEATURES = {"rtol": 1e-4, "atol": 1e-4}
"""float32 sums of up to 4608 products in two different orders, relative to the map's largest."""
HOMOGRAPHY_PX = 0.02
"""Exact correspondences through a float32 homography, pixels at 1000 px."""
UNIT = {"rtol": 1e-5, "atol": 1e-6}
"""Elementwise float32."""
GRADIENT = {"rtol": 2e-2, "atol": 1e-3}
"""Central differences in float32: truncation and rounding meet near 1 %."""
NEAR_TIE = 1e-5
"""Similarities closer than this may be ordered either way."""
ALIGNED_PX = 0.03
"""Sub-pixel alignment of smooth exact patches (periods of 8 pixels and more): what interpolation
leaves."""
EXACT_GRADIENT = {"rtol": 1e-4, "atol": 1e-8}
"""Central differences in float64, between the kinks of rectifiers and maxima."""
