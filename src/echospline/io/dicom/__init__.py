"""DICOM B-mode, single and multi-frame: spacing and tissue region from its regions, pixels through pydicom."""

from echospline.io.dicom.opening import open_dicom

__all__ = ["open_dicom"]
