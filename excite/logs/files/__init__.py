"""Readers of log files by suffix: each makes a table of columns, whatever the format."""

from __future__ import annotations

from excite.logs.files.canbus import read_can
from excite.logs.files.common import Reader, guarded
from excite.logs.files.excel import read_excel
from excite.logs.files.matlab import read_hdf5, read_matlab
from excite.logs.files.mdf import read_mdf
from excite.logs.files.parquet import read_parquet
from excite.logs.files.ros import read_bag, read_mcap
from excite.logs.files.text import read_text

_TEXT = guarded(read_text, "a table of text")
_MDF = guarded(read_mdf, "an MDF file")
_HDF5 = guarded(read_hdf5, "an HDF5 file")
_CAN = guarded(read_can, "a CAN log")

READERS: dict[str, Reader] = {
    ".csv": _TEXT,
    ".parquet": guarded(read_parquet, "a Parquet file"),
    ".mat": guarded(read_matlab, "a MATLAB file"),
    ".txt": _TEXT,
    ".tsv": _TEXT,
    ".gz": _TEXT,
    ".mf4": _MDF,
    ".mdf": _MDF,
    ".xlsx": guarded(read_excel, "an Excel file"),
    ".xlsm": guarded(read_excel, "an Excel file"),
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".bag": guarded(read_bag, "a ROS bag"),
    ".db3": guarded(read_bag, "a ROS bag"),
    ".mcap": guarded(read_mcap, "an MCAP file"),
    ".blf": _CAN,
    ".asc": _CAN,
}
__all__ = ["BAG_FOLDER", "READERS"]

BAG_FOLDER = "metadata.yaml"  # what the folder of a bag of ROS 2 holds
