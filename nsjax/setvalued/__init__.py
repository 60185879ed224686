"""Set-valued derivatives where the field has a kink or a jump, and how their eigenvalues cross."""

from ._crossing import EigenvalueCrossing as EigenvalueCrossing
from ._eigenvalue_crossings import (
    eigenvalue_crossings as eigenvalue_crossings,
    eigenvalue_path as eigenvalue_path,
    EigenvalueCurve as EigenvalueCurve,
    EigenvalueCurves as EigenvalueCurves,
    EigenvaluePath as EigenvaluePath,
)
from ._generalized_jacobian import (
    generalized_jacobian as generalized_jacobian,
    GeneralizedJacobian as GeneralizedJacobian,
)
