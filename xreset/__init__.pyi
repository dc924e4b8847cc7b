# The names of `import xreset`, for editors and type checkers; __init__.py imports each from here when it is first used.
from xreset.demos.archive import read_demos as read_demos
from xreset.demos.synth import synthesize as synthesize
from xreset.description import load_robot as load_robot
from xreset.env import ManipulationEnv as ManipulationEnv
from xreset.env import make_env as make_env
from xreset.eval.evaluate import evaluate as evaluate
from xreset.learning.train import train as train
from xreset.objects.catalogue import load_object as load_object
from xreset.plugins import make_backend as make_backend
from xreset.policy import OnnxPolicy as OnnxPolicy
from xreset.resets.bank import read_bank as read_bank
from xreset.resets.filter import make_bank as make_bank
from xreset.retarget.pipeline import retarget_demos as retarget_demos
from xreset.vector_env import VectorEnv as VectorEnv

__version__: str
