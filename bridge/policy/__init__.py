"""The one reader and checker of policy files (docs/policy_file.md): numpy and onnxruntime only, no ROS, no JAX.

All packages may import it. Everything in a policy file is checked before the first action is computed; what cannot be
trusted is refused with a `PolicyFileError` that names the file, the field, the value, the rule and the remedy.
"""

from bridge.policy.contract import (
    AGENT_KIND,
    KIND,
    SCHEMA,
    AgentContract,
    Contract,
    Tensor,
    check_kind,
    parse_hashes,
    parse_observation,
)
from bridge.policy.fields import Fields
from bridge.policy.parts import COPY_AGAIN, EXPORT_AGAIN, Parts, PolicyFileError, read_arrays, refusals, show
from bridge.policy.run import CheckedPolicy, Policy, make_session, read_policy
from bridge.policy.sensors import SensorInput, pacer_of

__all__ = [
    "AGENT_KIND", "COPY_AGAIN", "EXPORT_AGAIN", "KIND", "SCHEMA", "AgentContract", "CheckedPolicy", "Contract",
    "Fields", "Parts", "Policy", "PolicyFileError", "SensorInput", "Tensor", "check_kind", "make_session",
    "pacer_of", "parse_hashes", "parse_observation", "read_arrays", "read_policy", "refusals", "show",
]  # fmt: skip
