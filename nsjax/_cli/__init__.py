"""What `python -m nsjax` does, apart from reading its arguments."""

from ._arguments import parse as parse, USAGE as USAGE
from ._branch_record import branch_record as branch_record
from ._branches import draw_branches as draw_branches
from ._cache import (
    collect_rarely as collect_rarely,
    compile_loops_whole as compile_loops_whole,
    keep_compiled as keep_compiled,
)
from ._diagrams import Diagram as Diagram, diagram_for as diagram_for, DIAGRAMS as DIAGRAMS
from ._family import Arc as Arc, Followed as Followed
from ._follow import follow as follow, value_of as value_of
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
from ._scorecard import is_off as is_off, row_text as row_text, scorecard as scorecard
from ._search import (
    BOUNDS as BOUNDS,
    controller as controller,
    find as find,
    given_mode as given_mode,
    guess_of as guess_of,
    note as note,
    start_of as start_of,
    tolerances as tolerances,
)
