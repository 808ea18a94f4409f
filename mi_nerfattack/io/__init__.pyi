from .exr import read_layers as read_layers
from .exr import read_metadata as read_metadata
from .exr import write_layers as write_layers
from .files import read_image as read_image
from .files import read_json as read_json
from .files import write_image as write_image
from .files import write_json as write_json
from .video import write_video as write_video
