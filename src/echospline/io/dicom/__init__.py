"""DICOM B-mode, single and multi-frame: spacing and tissue region from its regions, pixels through pydicom."""

from echospline.io.dicom.opening import open_dicom
from echospline.io.dicom.volume import open_dicom_volume, slices

__all__ = ["open_dicom", "open_dicom_volume", "slices"]
