# SPDX-License-Identifier: Apache-2.0
"""The solar reference spectrum ASTM G173-03: sunlight and sky on a plane tilted 37 degrees to the sun, air mass 1.5.

The values are global irradiance in W/m2/nm, averaged over bins of the table that NREL publishes (SMARTS 2.9.2). The
air absorbs at some wavelengths: oxygen at 760 nm, water vapour at 720, 820 and around 940 nm. Some sensors use 940 nm
because there is less sunlight.
"""

from __future__ import annotations

import numpy as np

TOTAL_W_M2 = 1000.37
"""Irradiance in W/m2 over the whole table of the standard, 280 to 4000 nm."""
BELOW_W_M2 = 0.0015
"""Irradiance in W/m2 from 280 to 300 nm, which is below the first bin; source: the same table."""

EDGES_NM = np.concatenate([np.arange(300.0, 700.0, 10.0), np.arange(700.0, 1100.1, 5.0)])
"""Edges of the bins in nm: 10 nm apart up to 700 nm, and 5 nm apart from there to 1100 nm, where most sensors work."""

# fmt: off
SPECTRAL_W_M2_NM = np.array([
    0.0189, 0.1332, 0.3160, 0.4312, 0.4781, 0.5294, 0.6384, 0.6807, 0.6327, 0.7517,
    1.1547, 1.2012, 1.1878, 1.1998, 1.4340, 1.5444, 1.5586, 1.5794, 1.5296, 1.5685,
    1.5417, 1.4913, 1.5304, 1.5483, 1.5271, 1.5273, 1.5062, 1.4848, 1.4909, 1.4535,
    1.4748, 1.4548, 1.4189, 1.4327, 1.4195, 1.3608, 1.4072, 1.4047, 1.2771, 1.2733,
    # from 700 nm
    1.2835, 1.3114, 1.3011, 1.0907, 1.1077, 1.0672, 1.1657, 1.2092, 1.2311, 1.2425,
    1.2333, 1.1243, 0.4472, 0.9908, 1.1739, 1.1741, 1.1606, 1.1370, 1.0956, 1.0902,
    1.0755, 1.0751, 0.9936, 0.8581, 0.8945, 0.9280, 0.9337, 0.9983, 1.0030, 0.9887,
    0.9327, 0.9798, 0.9873, 0.9277, 0.9531, 0.9462, 0.9291, 0.9218, 0.8856, 0.6946,
    0.7161, 0.6983, 0.6527, 0.6699, 0.7350, 0.6407, 0.2888, 0.2571, 0.3523, 0.3183,
    0.3529, 0.3629, 0.4658, 0.5825, 0.6391, 0.6122, 0.6916, 0.7368, 0.7476, 0.7419,
    0.7278, 0.7174, 0.7187, 0.7042, 0.6951, 0.6927, 0.6836, 0.6764, 0.6691, 0.6571,
    0.6507, 0.6381, 0.6281, 0.6120, 0.6112, 0.6044, 0.5884, 0.5736, 0.5516, 0.5191,
])
# fmt: on
"""Mean spectral irradiance of each bin, W/m2/nm."""
