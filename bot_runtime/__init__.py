"""What runs inside a frame: bundles, policies, contexts, budgets and the Bots façade. Never imports torch."""

import os

# onnxruntime's wheels report usage to their maker unless told not to before the first import (its Privacy.md). A game
# server talks to nobody that its operator did not name; who wants the reports sets the variable to 0.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
