//! Offsets and bits of OTG_FS in device mode (RM0090, "OTG_FS control and status registers"). Names
//! are the manual's.

/// Offsets of the core global registers.
pub mod global {
    pub const GOTGCTL: u32 = 0x000;
    pub const GOTGINT: u32 = 0x004;
    pub const GAHBCFG: u32 = 0x008;
    pub const GUSBCFG: u32 = 0x00C;
    pub const GRSTCTL: u32 = 0x010;
    pub const GINTSTS: u32 = 0x014;
    pub const GINTMSK: u32 = 0x018;
    pub const GRXSTSR: u32 = 0x01C;
    pub const GRXSTSP: u32 = 0x020;
    pub const GRXFSIZ: u32 = 0x024;
    pub const DIEPTXF0: u32 = 0x028;
    pub const HNPTXSTS: u32 = 0x02C;
    pub const GCCFG: u32 = 0x038;
    pub const CID: u32 = 0x03C;
    pub const HPTXFSIZ: u32 = 0x100;
    pub const DIEPTXF1: u32 = 0x104;
    pub const DIEPTXF3: u32 = 0x10C;
}

/// Offsets of the device-mode registers.
pub mod device {
    pub const DCFG: u32 = 0x800;
    pub const DCTL: u32 = 0x804;
    pub const DSTS: u32 = 0x808;
    pub const DIEPMSK: u32 = 0x810;
    pub const DOEPMSK: u32 = 0x814;
    pub const DAINT: u32 = 0x818;
    pub const DAINTMSK: u32 = 0x81C;
    pub const DVBUSDIS: u32 = 0x828;
    pub const DVBUSPULSE: u32 = 0x82C;
    pub const DIEPEMPMSK: u32 = 0x834;
    /// First IN endpoint; each takes [`ENDPOINT_STRIDE`] bytes.
    pub const IN_ENDPOINTS: u32 = 0x900;
    /// First OUT endpoint.
    pub const OUT_ENDPOINTS: u32 = 0xB00;
    pub const ENDPOINT_STRIDE: u32 = 0x20;
    /// Within an endpoint: control, interrupt, transfer size, free FIFO words (IN only).
    pub const EPCTL: u32 = 0x00;
    pub const EPINT: u32 = 0x08;
    pub const EPTSIZ: u32 = 0x10;
    pub const TXFSTS: u32 = 0x18;
    /// Power and clock gating.
    pub const PCGCCTL: u32 = 0xE00;
}

/// FIFO n is reached through the 4 KiB from `FIFOS + n * FIFO_STRIDE`.
pub const FIFOS: u32 = 0x1000;
pub const FIFO_STRIDE: u32 = 0x1000;

/// Bits of GAHBCFG.
pub mod gahbcfg {
    pub const GINT: u32 = 1 << 0;
    pub const TXFELVL: u32 = 1 << 7;
}

/// Bits of GUSBCFG.
pub mod gusbcfg {
    pub const FDMOD: u32 = 1 << 30;
}

/// Bits of GRSTCTL.
pub mod grstctl {
    pub const CSRST: u32 = 1 << 0;
    pub const RXFFLSH: u32 = 1 << 4;
    pub const TXFFLSH: u32 = 1 << 5;
    pub const TXFNUM_SHIFT: u32 = 6;
    pub const TXFNUM_ALL: u32 = 0x10;
    pub const AHBIDL: u32 = 1 << 31;
}

/// Bits of GINTSTS and GINTMSK.
pub mod gint {
    /// Current mode: host.
    pub const CMOD: u32 = 1 << 0;
    pub const SOF: u32 = 1 << 3;
    pub const RXFLVL: u32 = 1 << 4;
    pub const NPTXFE: u32 = 1 << 5;
    pub const GINAKEFF: u32 = 1 << 6;
    pub const GONAKEFF: u32 = 1 << 7;
    pub const ESUSP: u32 = 1 << 10;
    pub const USBSUSP: u32 = 1 << 11;
    pub const USBRST: u32 = 1 << 12;
    pub const ENUMDNE: u32 = 1 << 13;
    pub const EOPF: u32 = 1 << 15;
    pub const IEPINT: u32 = 1 << 18;
    pub const OEPINT: u32 = 1 << 19;
    pub const SRQINT: u32 = 1 << 30;
    pub const WKUPINT: u32 = 1 << 31;
    /// Flags that are cleared by writing 1; the others follow the condition they report.
    pub const WRITE_CLEARS: u32 = SOF
        | ESUSP
        | USBSUSP
        | USBRST
        | ENUMDNE
        | EOPF
        | SRQINT
        | WKUPINT
        | 1 << 1
        | 3 << 20
        | 1 << 14
        | 3 << 28;
}

/// Bits of GCCFG.
pub mod gccfg {
    pub const PWRDWN: u32 = 1 << 16;
    pub const NOVBUSSENS: u32 = 1 << 21;
    pub const VBUSBSEN: u32 = 1 << 19;
}

/// Fields of DCFG.
pub mod dcfg {
    pub const DAD_SHIFT: u32 = 4;
    pub const DAD: u32 = 0x7F << DAD_SHIFT;
}

/// Bits of DCTL.
pub mod dctl {
    pub const SDIS: u32 = 1 << 1;
    pub const GINSTS: u32 = 1 << 2;
    pub const GONSTS: u32 = 1 << 3;
    pub const SGINAK: u32 = 1 << 7;
    pub const CGINAK: u32 = 1 << 8;
    pub const SGONAK: u32 = 1 << 9;
    pub const CGONAK: u32 = 1 << 10;
    /// Bits that store what is written.
    pub const STORED: u32 = 1 << 0 | SDIS | 7 << 4 | 1 << 11;
}

/// Bits of DSTS.
pub mod dsts {
    pub const SUSPSTS: u32 = 1 << 0;
    /// Full speed with the internal PHY at 48 MHz.
    pub const ENUMSPD_FULL: u32 = 3 << 1;
    pub const FNSOF_SHIFT: u32 = 8;
}

/// Bits of DIEPCTLx and DOEPCTLx.
pub mod epctl {
    pub const MPSIZ: u32 = 0x7FF;
    pub const USBAEP: u32 = 1 << 15;
    pub const DPID: u32 = 1 << 16;
    pub const NAKSTS: u32 = 1 << 17;
    pub const EPTYP: u32 = 3 << 18;
    pub const SNPM: u32 = 1 << 20;
    pub const STALL: u32 = 1 << 21;
    pub const TXFNUM_SHIFT: u32 = 22;
    pub const TXFNUM: u32 = 0xF << TXFNUM_SHIFT;
    pub const CNAK: u32 = 1 << 26;
    pub const SNAK: u32 = 1 << 27;
    pub const SD0PID: u32 = 1 << 28;
    pub const SODDFRM: u32 = 1 << 29;
    pub const EPDIS: u32 = 1 << 30;
    pub const EPENA: u32 = 1 << 31;
}

/// Bits of DIEPINTx and DOEPINTx.
pub mod epint {
    pub const XFRC: u32 = 1 << 0;
    pub const EPDISD: u32 = 1 << 1;
    /// OUT: SETUP phase done.
    pub const STUP: u32 = 1 << 3;
    /// IN: token received while the FIFO was empty. OUT: token received while the endpoint was disabled.
    pub const TOKEN_UNSERVED: u32 = 1 << 4;
    pub const INEPNE: u32 = 1 << 6;
    /// IN: the FIFO is empty, or half empty. Follows the FIFO.
    pub const TXFE: u32 = 1 << 7;
}

/// Fields of DIEPTSIZx and DOEPTSIZx.
pub mod eptsiz {
    pub const XFRSIZ: u32 = 0x7_FFFF;
    pub const PKTCNT_SHIFT: u32 = 19;
    pub const PKTCNT: u32 = 0x3FF << PKTCNT_SHIFT;
}

/// Packet states in the receive status queue (GRXSTSR, PKTSTS).
pub mod pktsts {
    pub const GLOBAL_OUT_NAK: u32 = 1;
    pub const OUT_DATA: u32 = 2;
    pub const OUT_COMPLETE: u32 = 3;
    pub const SETUP_COMPLETE: u32 = 4;
    pub const SETUP_DATA: u32 = 6;
}
