"""The protocols of `gsencoder evaluate protocol=NAME`, one line each."""

from gsencoder.evaluate.benchmarks.absent import AbsentProtocol
from gsencoder.evaluate.benchmarks.grounding import GroundingProtocol
from gsencoder.evaluate.benchmarks.instances import InstancesProtocol
from gsencoder.evaluate.benchmarks.localization import LocalizationProtocol
from gsencoder.evaluate.benchmarks.naming import NamingProtocol
from gsencoder.evaluate.benchmarks.recognition import RecognitionProtocol
from gsencoder.evaluate.benchmarks.referring import ReferringProtocol
from gsencoder.evaluate.benchmarks.retrieval import RetrievalProtocol
from gsencoder.evaluate.benchmarks.semantics import SemanticsProtocol

AnyProtocol = (
    LocalizationProtocol
    | NamingProtocol
    | AbsentProtocol
    | GroundingProtocol
    | RecognitionProtocol
    | InstancesProtocol
    | SemanticsProtocol
    | ReferringProtocol
    | RetrievalProtocol
)
