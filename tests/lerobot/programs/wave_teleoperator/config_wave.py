"""Options of the teleoperator ``wave``."""

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("wave")
@dataclass(kw_only=True)
class WaveConfig(TeleoperatorConfig):
    """A sine wave of the first joint of the SO-101.

    Attributes:
        amplitude_deg: Amplitude.
        period: Period, s.
    """

    amplitude_deg: float = 15.0
    period: float = 2.0
