# The names of `import xreset`, for editors and type checkers; __init__.py imports each from here when it is first used.
from xreset.demos.archive import Demos as Demos
from xreset.demos.archive import read_demos as read_demos
from xreset.demos.archive import write_demos as write_demos
from xreset.demos.synth import synthesize as synthesize
from xreset.description import load_robot as load_robot
from xreset.env import ManipulationEnv as ManipulationEnv
from xreset.env import make_env as make_env
from xreset.errors import XResetError as XResetError
from xreset.eval.evaluate import evaluate as evaluate
from xreset.eval.film import film as film
from xreset.eval.policy_spec import PolicySpec as PolicySpec
from xreset.eval.policy_spec import load_policy as load_policy
from xreset.eval.results import EvalResult as EvalResult
from xreset.eval.results import Evaluation as Evaluation
from xreset.eval.trial import Engine as Engine
from xreset.learning.config import TrainConfig as TrainConfig
from xreset.learning.train import train as train
from xreset.objects.catalogue import load_object as load_object
from xreset.physics import Backend as Backend
from xreset.plugins import make_backend as make_backend
from xreset.policy import OnnxPolicy as OnnxPolicy
from xreset.resets.bank import ResetBank as ResetBank
from xreset.resets.bank import read_bank as read_bank
from xreset.resets.bank import write_bank as write_bank
from xreset.resets.config import ClosingConfig as ClosingConfig
from xreset.resets.config import SqueezeConfig as SqueezeConfig
from xreset.resets.filter import make_bank as make_bank
from xreset.retarget.file import Retargeted as Retargeted
from xreset.retarget.pipeline import RetargetConfig as RetargetConfig
from xreset.retarget.pipeline import retarget_demos as retarget_demos
from xreset.spec import ObjectSpec as ObjectSpec
from xreset.spec import RobotSpec as RobotSpec
from xreset.spec import SceneSpec as SceneSpec
from xreset.task.config import TaskConfig as TaskConfig
from xreset.vector_env import VectorEnv as VectorEnv

__version__: str
