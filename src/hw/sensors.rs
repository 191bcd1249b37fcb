//! The chip's own thermometer and supply voltage, through ADC1.

use stm32f4xx_hal::pac::{ADC_COMMON, ADC1};
use stm32f4xx_hal::rcc::{Enable, Rcc};
use stm32f4xx_hal::signature::{VDDA_CALIB, VrefCal, VtempCal30, VtempCal110};

/// ADC1's channel of the temperature sensor on the F405/407 (RM0090, "Temperature sensor").
const TEMPERATURE: u8 = 16;
/// ADC1's channel of the internal reference voltage.
const REFERENCE: u8 = 17;
/// A conversion takes 480 + 12 clocks at 18 MHz, 27 µs; this many reads of a register take longer. The bound keeps
/// a chip without an ADC from hanging.
const MOST_READS: u32 = 10_000;
/// Longest sampling time, 480 clocks at 18 MHz = 27 µs; the sensors need 10 µs (STM32F405 data sheet,
/// "Temperature sensor characteristics" and "Embedded reference voltage").
const SAMPLE_480: u8 = 0b111;

/// ADC1, switched on.
pub struct Sensors(ADC1);

impl Sensors {
    /// Switches the ADC and the sensors on.
    pub fn start(adc: ADC1, common: &ADC_COMMON, rcc: &mut Rcc) -> Self {
        ADC1::enable(rcc);
        // 72 MHz / 4 = 18 MHz; at most 36 (data sheet, "ADC characteristics").
        common.ccr().modify(|_, w| w.adcpre().div4().tsvrefe().enabled());
        adc.cr2().modify(|_, w| w.adon().enabled());
        adc.smpr1().modify(|_, w| {
            // SAFETY: one of the field's eight values.
            unsafe { w.smp16().bits(SAMPLE_480).smp17().bits(SAMPLE_480) }
        });
        Self(adc)
    }

    /// The supply voltage, in mV.
    pub fn supply_millivolts(&mut self) -> Option<u16> {
        let calibration = calibration(VrefCal::get().read())?;
        let sample = self.convert(REFERENCE)?;
        let millivolts = (VDDA_CALIB * calibration).checked_div(sample)?;
        u16::try_from(millivolts).ok()
    }

    /// The temperature, in 0.1 °C.
    pub fn temperature_decicelsius(&mut self) -> Option<i16> {
        let at_30 = calibration(VtempCal30::get().read())?;
        let at_110 = calibration(VtempCal110::get().read())?;
        let supply = u32::from(self.supply_millivolts()?);
        // The sample as it would be at the calibration's supply voltage.
        let sample = self.convert(TEMPERATURE)? * supply / VDDA_CALIB;
        let rise = (sample as i32 - at_30 as i32) * 800;
        let temperature = 300 + rise.checked_div(at_110 as i32 - at_30 as i32)?;
        i16::try_from(temperature).ok()
    }

    fn convert(&mut self, channel: u8) -> Option<u32> {
        // SAFETY: the field takes channels up to 18.
        self.0.sqr3().modify(|_, w| unsafe { w.sq1().bits(channel) });
        self.0.sr().modify(|_, w| w.eoc().clear_bit());
        self.0.cr2().modify(|_, w| w.swstart().start());
        for _ in 0..MOST_READS {
            if self.0.sr().read().eoc().bit() {
                return Some(u32::from(self.0.dr().read().data().bits()));
            }
        }
        None
    }
}

/// A factory calibration value, if there is one.
fn calibration(value: u16) -> Option<u32> {
    (1..0xFFF).contains(&value).then_some(u32::from(value))
}
