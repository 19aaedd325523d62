"""``python -m halbach_fe``."""

import sys

from halbach_fe.cli import main

sys.exit(main())
