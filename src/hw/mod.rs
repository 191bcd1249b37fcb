//! The board's side of the firmware: the logic's traits over stm32f4xx-hal and its registers. The only
//! place with `unsafe`.

mod panic;
