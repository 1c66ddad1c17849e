# SPDX-License-Identifier: Apache-2.0
"""A client of `pcgraph serve`: the boxes of the objects of a file.

Usage: python client.py FILE [ADDRESS]
"""

import json
import sys
from pathlib import Path
from urllib.parse import urlencode
from urllib.request import urlopen

path, address = Path(sys.argv[1]), (*sys.argv[2:], "http://127.0.0.1:8000")[0]
with urlopen(f"{address}/segmentations?{urlencode({'name': path.name, 'wait': 60})}", path.read_bytes()) as answer:
    links = json.load(answer)["links"]
with urlopen(address + links["boxes"]) as answer:
    for box in json.load(answer)["boxes"]:
        print(box["segment"], *box["size"])
