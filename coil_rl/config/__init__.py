"""From YAML to a run: schema, composition, checks, trust.

Besides the programs it is the only package that reads YAML.
"""

import coil_rl.config.default_method  # noqa: F401  registers its resolver with Hydra
import coil_rl.config.guest_files  # noqa: F401  registers its search path with Hydra
import coil_rl.config.schema  # noqa: F401  registers the root configurations and resolvers with Hydra
