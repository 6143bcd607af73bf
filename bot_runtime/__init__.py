"""What runs in a frame. This room knows nothing about bytes, sockets or torch."""

import os

# onnxruntime 1.31 reports usage over the network unless told not to before it is first imported. A game server must not
# talk to anyone that its operator did not name; who wants it sets the variable to 0.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
