"""``python -m afm_rl.cli`` is ``afm-rl``."""

from afm_rl.cli import main

main()
