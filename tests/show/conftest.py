"""The folder itself is importable, so that tests share the driver of the browser."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
