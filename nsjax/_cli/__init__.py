"""What `python -m nsjax` does, apart from reading its arguments."""

from ._branches import (
    Arc as Arc,
    branch_record as branch_record,
    Diagram as Diagram,
    diagram_for as diagram_for,
    DIAGRAMS as DIAGRAMS,
    draw_branches as draw_branches,
)
from ._job import Job as Job, load as load, numbers as numbers, options as options, UsageError as UsageError
from ._pictures import draw as draw
from ._report import (
    orbit_record as orbit_record,
    record as record,
    report as report,
    simulation_record as simulation_record,
)
