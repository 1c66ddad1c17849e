# SPDX-License-Identifier: Apache-2.0
"""Trains a small network to tell which readings of a sensor are wrong, on a data set of `rangesim dataset`.

    rangesim dataset examples/dataset_bin.toml --out out/bins
    python examples/train_on_dataset.py out/bins amcw

rangesim does not need torch; install it beside (https://pytorch.org). `Samples` is a sequence, which DataLoader takes
as it is: it shuffles by the seed, and gives each worker process and each rank samples of its own.
"""

import sys

import numpy as np
import torch
from torch.utils.data import DataLoader

from rangesim.dataset import Samples

INPUTS = ("reading_m", "confidence", "intensity")


def batch(samples):
    """Inputs (n, 3, h, w), and whether each reading is wrong (n, 1, h, w): 1 or 0, and NaN where there is none."""
    arrays = [(sample[f"sensor.{sensor}"], sample["camera.1"]["true_m"]) for sample in samples]
    inputs = np.stack([[np.nan_to_num(readings[name].astype("f4")) for name in INPUTS] for readings, _ in arrays])
    errors = np.stack([np.abs(readings["reading_m"] - true) for readings, true in arrays])[:, None]
    scale = inputs.std(axis=(0, 2, 3), keepdims=True) + 1e-6
    wrong = np.where(np.isfinite(errors), errors > 0.01, np.nan).astype("f4")
    return torch.from_numpy(inputs / scale), torch.from_numpy(wrong)


store, sensor = sys.argv[1:3]
torch.manual_seed(0)
samples = Samples(store, members=("camera.1", f"sensor.{sensor}"))
loader = DataLoader(samples, batch_size=4, shuffle=True, collate_fn=batch, num_workers=2)
layers = [torch.nn.Conv2d(3, 16, 5, padding=2), torch.nn.ReLU(), torch.nn.Conv2d(16, 16, 5, padding=2)]
network = torch.nn.Sequential(*layers, torch.nn.ReLU(), torch.nn.Conv2d(16, 1, 1))
optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
for epoch in range(10):
    losses = []
    for inputs, wrong in loader:
        known = torch.isfinite(wrong)
        loss = torch.nn.functional.binary_cross_entropy_with_logits(network(inputs)[known], wrong[known])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    print(f"epoch {epoch}: loss {np.mean(losses):.4f}")
