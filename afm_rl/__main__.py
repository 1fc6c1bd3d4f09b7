"""``python -m afm_rl`` is ``afm-rl``."""

from afm_rl.cli import main

if __name__ == "__main__":
    main()
