"""The formats of log files that are read: endings, reader, library. Help, reference and app take them from here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Format:
    """A format of log files.

    kind: as messages call it. suffixes: its endings. reader: function and its module in `files`. extra: of
    `pip install 'excite[extra]'` that brings its library, "" where none is needed. columns: how its channels are named.
    """

    kind: str
    suffixes: tuple[str, ...]
    reader: str
    columns: str
    extra: str = ""


FORMATS = (
    Format(
        "a table of text",
        (".csv", ".txt", ".tsv", ".dat", ".lvm", ".gz"),
        "text.read_text",
        "as in its header; LabVIEW's and TwinCAT Scope's by channel",
    ),
    Format("a Parquet file", (".parquet",), "parquet.read_parquet", "as in it; `imu.gyro`, `q[0]` of what is nested"),
    Format("a MATLAB file", (".mat",), "matlab.read_matlab", "as the variable; `log.q` in a struct", "hdf5"),
    Format("an HDF5 file", (".h5", ".hdf5"), "matlab.read_hdf5", "`group/name`", "hdf5"),
    Format("an MDF file", (".mf4", ".mdf"), "mdf.read_mdf", "as the channel", "mdf"),
    Format("an Excel file", (".xlsx", ".xlsm"), "excel.read_excel", "as in its header", "xlsx"),
    Format("a ROS bag", (".bag", ".db3"), "ros.read_bag", "`/joint_states/position[elbow]`, or `[0]`", "ros"),
    Format("an MCAP file", (".mcap",), "ros.read_mcap", "`/joint_states/position[elbow]`, or `[0]`", "ros"),
    Format(
        "a CAN log", (".blf", ".asc", ".log"), "canbus.read_can", "`Message.Signal` of the DBC file beside it", "can"
    ),
    Format("a TDMS file", (".tdms",), "tdms.read_tdms", "`group/channel`", "tdms"),
    Format("a ULog file", (".ulg",), "ulog.read_ulog", "`topic/field`, `topic.1/field` of a second sensor", "ulog"),
)
PROFILE = "profile.csv"  # the drive in the folder of a design
BAG_FOLDER = "metadata.yaml"  # what the folder of a bag of ROS 2 holds
SUFFIXES = tuple(suffix for form in FORMATS for suffix in form.suffixes)
ENDINGS = ", ".join(SUFFIXES)
