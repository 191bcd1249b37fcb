"""What `spark-submit` starts. The package beside it is sent to the workers from here."""

import sys

from cantap_fleet.command import main

if __name__ == "__main__":
    sys.exit(main())
