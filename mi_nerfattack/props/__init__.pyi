from .attacked import AttackedBox as AttackedBox
from .attacked import read_box as read_box
from .monitor import Screen as Screen
from .monitor import screen_image as screen_image
from .overlay import Overlay as Overlay
from .paper import write_net as write_net
from .rehearsal import RenderedCamera as RenderedCamera
