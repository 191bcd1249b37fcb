//! The formats that are read and written. What is known of each stands in its row of the table in `spec.rs`.

use super::csv::CsvDialect;
use super::trc::TrcVersion;

/// A trace file format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Format {
    /// can-utils' log, as `candump -l` writes it.
    Candump,
    /// Vector's text format.
    Asc,
    /// Vector's binary format.
    Blf,
    /// PEAK's trace. Reading takes the version from the file.
    Trc(TrcVersion),
    /// Comma-separated values. Reading takes the dialect from the file.
    Csv(CsvDialect),
    /// Wireshark's format, with SocketCAN packets.
    Pcapng,
    /// The older format of Wireshark and tcpdump.
    Pcap,
    /// The earlier CANanalyser's table in the format of old spreadsheets.
    Dif,
    /// ASAM MDF 4 with the traffic of buses, as loggers write it.
    Mf4,
    /// What candump shows on a screen.
    CandumpScreen,
    /// BUSMASTER's log.
    Busmaster,
    /// The log of the Open Vehicle Monitoring System.
    Crtd,
    /// Kvaser's text of a Memorator's log.
    Kvaser,
    /// The log of Microchip's CAN Bus Analyzer.
    Microchip,
    /// CANHacker's trace.
    CanHacker,
    /// What python-can's Printer prints.
    Printer,
    /// What Kvaser's CanKing shows.
    CanKing,
    /// python-can's table in an SQLite database.
    Sqlite,
    /// The table that the converters for CANedge loggers make.
    CanEdgeCsv,
    /// The log of Battery-Emulator.
    BatteryEmulator,
    /// What gateways between NMEA 2000 and computers print.
    Nmea2000,
    /// The trace of CARBUS Analyzer.
    Carbus,
    /// The tables that the programs for USBCAN adapters save.
    UsbCan,
    /// Frames that a sketch printed, each part behind its label.
    Labelled,
    /// What came from the port of an slcan adapter.
    Slcan,
    /// What `rostopic echo` and `ros2 topic echo` print of a bus.
    RosEcho,
    /// A table of any columns.
    Table,
    /// openpilot's log of a drive.
    Rlog,
    /// What ROS 2 records, and Foxglove shows.
    Mcap,
    /// What ROS 1 records.
    RosBag,
    /// A table in Parquet: a row for each record, or frames in any columns.
    Parquet,
    /// A JSON object for each frame.
    Json,
    /// The table that Saleae's Logic 2 exports of its CAN analyser.
    Saleae,
    /// The log of CANServer, a logger for Teslas.
    CanServer,
    /// The binary log of Actisense's gateways for NMEA 2000, or what such a gateway sent.
    Actisense,
    /// The trace window of CANalyzer and CANoe, copied as text.
    TraceWindow,
    /// The log of ESPHome's component for CAN.
    EspHome,
    /// What sigrok's CAN decoder prints.
    Sigrok,
}
