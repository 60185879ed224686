"""What `python -m nsjax` does, apart from reading its arguments."""

from ._job import Job as Job, load as load, options as options, UsageError as UsageError
from ._pictures import draw as draw
from ._report import (
    orbit_record as orbit_record,
    record as record,
    report as report,
    simulation_record as simulation_record,
)
