# SPDX-License-Identifier: Apache-2.0
"""A client of `pcgraph serve`: the boxes of the objects of a file.

Usage: [PCGRAPH_TOKEN=...] python client.py FILE [ADDRESS]
"""

import json
import os
import sys
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import Request, urlopen

path, address = Path(sys.argv[1]), (*sys.argv[2:], "http://127.0.0.1:8000")[0]
headers = {"Authorization": f"Bearer {os.environ['PCGRAPH_TOKEN']}"} if "PCGRAPH_TOKEN" in os.environ else {}


def answer(link: str, body: bytes | None = None) -> dict:
    """What the service answers; the program ends with the reason if it refuses."""
    try:
        with urlopen(Request(address + link, body, headers)) as response:
            return json.load(response)
    except HTTPError as error:
        sys.exit(error.read().decode())


made = answer(f"/segmentations?{urlencode({'name': path.name, 'wait': 60})}", path.read_bytes())
for box in answer(made["links"]["boxes"])["boxes"]:
    print(box["segment"], *box["size"])
