"""The file that `spark-submit` starts. It sends the package beside it to the workers."""

import sys

from cantap_fleet.command import main

if __name__ == "__main__":
    sys.exit(main())
