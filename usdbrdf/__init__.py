"""usdbrdf: measured materials for captured rooms and objects, as non-destructive USD layers."""

from usdbrdf.asset.schema import register as _register

_register()

from usdbrdf.capture.ingest_options import IngestOptions as IngestOptions  # noqa: E402
from usdbrdf.delivery.package import PackageOptions as PackageOptions  # noqa: E402
from usdbrdf.delivery.package import package as package  # noqa: E402
from usdbrdf.evaluation.compare_assets import compare as compare  # noqa: E402
from usdbrdf.evaluation.evaluate_views import EvaluateOptions as EvaluateOptions  # noqa: E402
from usdbrdf.evaluation.evaluate_views import evaluate as evaluate  # noqa: E402
from usdbrdf.material.fit_objects import FitOptions as FitOptions  # noqa: E402
from usdbrdf.pipeline import ConvertOptions as ConvertOptions  # noqa: E402
from usdbrdf.pipeline import convert as convert  # noqa: E402
from usdbrdf.pipeline import working_on as working_on  # noqa: E402
from usdbrdf.relighting.insert import Insert as Insert  # noqa: E402
from usdbrdf.relighting.relight import RelightOptions as RelightOptions  # noqa: E402
from usdbrdf.relighting.relight import relight as relight  # noqa: E402
from usdbrdf.tasks.fit import fit as fit  # noqa: E402
from usdbrdf.tasks.ingest import ingest as ingest  # noqa: E402
from usdbrdf.tasks.shade import ShadeOptions as ShadeOptions  # noqa: E402
from usdbrdf.tasks.shade import shade as shade  # noqa: E402
from usdbrdf.tasks.texture import TextureOptions as TextureOptions  # noqa: E402
from usdbrdf.tasks.texture import texture as texture  # noqa: E402
from usdbrdf.transport.irradiance import Sampling as Sampling  # noqa: E402
