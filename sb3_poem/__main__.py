import sys

from sb3_poem.cli import main

if __name__ == "__main__":
    sys.exit(main())
