"""What `python -m nsjax` does, apart from reading its arguments."""

from ._arguments import parse as parse, USAGE as USAGE
from ._branches import (
    Arc as Arc,
    branch_record as branch_record,
    Diagram as Diagram,
    diagram_for as diagram_for,
    DIAGRAMS as DIAGRAMS,
    draw_branches as draw_branches,
)
from ._cache import keep_programs as keep_programs
from ._job import (
    Job as Job,
    load as load,
    model_file as model_file,
    numbers as numbers,
    options as options,
    unknown as unknown,
    UsageError as UsageError,
)
from ._mistakes import (
    advice as advice,
    first_line as first_line,
    is_ours as is_ours,
    mistake as mistake,
    raised_inside as raised_inside,
)
from ._pictures import draw as draw
from ._report import (
    orbit_record as orbit_record,
    record as record,
    report as report,
    simulation_record as simulation_record,
)
