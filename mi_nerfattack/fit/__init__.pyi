from .fit import fit_grid as fit_grid
from .fit import fit_ngp as fit_ngp
from .fit import fit_object as fit_object
from .loss import LossWeights as LossWeights
from .options import FitOptions as FitOptions
from .options import FitProgress as FitProgress
from .options import FitResult as FitResult
from .scores import FieldRenderer as FieldRenderer
