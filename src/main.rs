//! The firmware's RTIC application: which interrupt does what, at which priority.
//!
//! | priority | tasks | why |
//! |---|---|---|
//! | 5 | both channels' receive and transmit interrupts: the stamp, and nothing else | a late stamp is a wrong one |
//! | 4 | draining both FIFOs, confirming, error interrupts, the transmission alarm | a FIFO of three frames waits 141 µs |
//! | 3 | edges of a receive pin being measured | USB would blur it, and capture must not wait |
//! | 2 | USB, the millisecond tick | a host can be made to wait |
//! | – | idle | sleeps |
//!
//! Everything at one priority runs to its end before the next begins, so what only it touches needs no lock. Of those pending, the
//! lowest vector goes first (Armv7-M architecture reference manual, "Exception number and priority"): at priority 4 the two draining
//! tasks have the lowest vectors, so transmission never goes before capture, however much of it a host asks for. Priority 2 reaches
//! what priority 4 owns through RTIC's lock, which raises BASEPRI and so never holds up a stamp. Nothing masks priority 5: all of USB
//! runs at priority 2, with a driver that needs no mask (`hw/usb`).
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod board;
#[cfg(target_os = "none")]
mod hw;

#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!("this program is for the board; build it with `cargo fw`, and use the library on the host");
}

#[cfg(target_os = "none")]
#[rtic::app(device = stm32f4xx_hal::pac, peripherals = true)]
mod app {
    use core::sync::atomic::{AtomicU32, Ordering};

    use cantap_firmware::bus::capture::{CALLS_PER_TICK, Capture};
    use cantap_firmware::bus::filters::Layout;
    use cantap_firmware::bus::gateway::Lane;
    use cantap_firmware::bus::queue::RecordQueue;
    use cantap_firmware::bus::transmit::TxQueue;
    use cantap_firmware::lights::Activity;
    use cantap_firmware::oddities::{Oddities, Watch};
    use cantap_firmware::port::session::{self, Session};
    use cantap_firmware::ports::{FilterBanks, Traffic};
    use cantap_wire::{CHANNELS, Channel};

    use stm32f4xx_hal::pac::Interrupt;

    use crate::hw::access::{Access, Controls, Tap};
    use crate::hw::can::Bells;
    use crate::hw::edges::EdgeCatcher;
    use crate::hw::stamp::StampTimer;
    use crate::hw::tick::Tick;
    use crate::hw::usb::{Memory, UsbPort};
    use crate::hw::watchdog::Watchdog;
    use crate::hw::{self, Hardware};

    #[shared]
    struct Shared {
        /// Ceiling 4: what the tasks of priority 4 own.
        tap: Tap,
        /// Readable at any priority.
        stamp: StampTimer,
        /// Notes the edges of the receive pin being measured.
        catcher: EdgeCatcher,
        /// The switches of CAN1's interrupts.
        can1_bells: Bells<0>,
        /// The switches of CAN2's interrupts.
        can2_bells: Bells<1>,
        /// When the interrupt stamped CAN1's last frame.
        can1_entered: AtomicU32,
        /// When the interrupt stamped CAN2's last frame.
        can2_entered: AtomicU32,
        /// When the interrupt stamped CAN1's last transmission.
        can1_sent_at: &'static AtomicU32,
        /// When the interrupt stamped CAN2's last transmission.
        can2_sent_at: &'static AtomicU32,
        /// Only at priority 2.
        #[lock_free]
        session: Session<'static>,
        /// Only at priority 2.
        #[lock_free]
        usb: UsbPort,
        /// Only at priority 2.
        #[lock_free]
        controls: Controls,
    }

    #[local]
    struct Local {
        tick: Tick,
        watchdog: Watchdog,
    }

    // Large objects are constructed here, in place: a value returned by `init` would pass over the stack.
    #[init(local = [
        records: RecordQueue = RecordQueue::new(),
        tx_memory: [TxQueue; CHANNELS] = [const { TxQueue::new() }; CHANNELS],
        lanes: [Lane; CHANNELS] = [const { Lane::new() }; CHANNELS],
        session_memory: session::Memory = session::Memory::new(),
        usb_memory: Memory = Memory::new(),
        sent_at: [AtomicU32; CHANNELS] = [const { AtomicU32::new(0) }; CHANNELS],
    ])]
    fn init(cx: init::Context) -> (Shared, Local) {
        let init::LocalResources { records, tx_memory, lanes, session_memory, usb_memory, sent_at, .. } =
            cx.local;
        let sent_at: &'static [AtomicU32; CHANNELS] = sent_at;
        let [can1_sent_at, can2_sent_at] = sent_at;
        let hardware = hw::start(cx.device, usb_memory, sent_at);
        let Hardware {
            can,
            alarm,
            #[cfg(feature = "disturb")]
            pulse,
            sof,
            tick,
            crc,
            meter,
            catcher,
            usb,
            mut chip,
            watchdog,
            identity,
            restarted_after_failure,
        } = hardware;
        chip.tick(Activity { error: restarted_after_failure, ..Activity::default() });
        let (can1_bells, can2_bells) = can.bells;
        let stamp = alarm.timer();
        let mut filters = can.filters;
        filters.write(&Layout::open());
        let (producer, consumer) = records.split();
        (
            Shared {
                tap: Tap {
                    capture: Capture::new(producer, tx_memory, lanes),
                    traffic: can.traffic,
                    alarm,
                    #[cfg(feature = "disturb")]
                    disturber: cantap_firmware::bus::disturb::Disturber::new(),
                    #[cfg(feature = "disturb")]
                    pulse,
                },
                stamp,
                catcher,
                can1_bells,
                can2_bells,
                can1_entered: AtomicU32::new(0),
                can2_entered: AtomicU32::new(0),
                can1_sent_at,
                can2_sent_at,
                session: Session::new(consumer, identity, session_memory),
                usb,
                controls: Controls { can: can.control, filters, chip, stamp, sof, crc, meter },
            },
            Local { tick, watchdog },
        )
    }

    /// Stamps the end of a frame on CAN1, and leaves the frame to [`can1_drain`].
    ///
    /// Priority 5, the highest, and a dozen instructions: each microsecond of delay makes the stamp a microsecond late. Only
    /// [`can2_rx0`] and the two transmit interrupts can delay it, by a dozen instructions each.
    #[task(binds = CAN1_RX0, priority = 5, shared = [&stamp, &can1_bells, &can1_entered])]
    fn can1_rx0(cx: can1_rx0::Context) {
        cx.shared.can1_entered.store(cx.shared.stamp.now(), Ordering::Relaxed);
        cx.shared.can1_bells.silence_receive();
        rtic::pend(Interrupt::CAN1_RX1);
    }

    /// Same as [`can1_rx0`], for CAN2.
    #[task(binds = CAN2_RX0, priority = 5, shared = [&stamp, &can2_bells, &can2_entered])]
    fn can2_rx0(cx: can2_rx0::Context) {
        cx.shared.can2_entered.store(cx.shared.stamp.now(), Ordering::Relaxed);
        cx.shared.can2_bells.silence_receive();
        rtic::pend(Interrupt::DMA1_STREAM0);
    }

    /// Moves frames from CAN1's FIFO 0 to the record queue. FIFO 1 is not used, and its interrupt raises this task.
    ///
    /// Priority 4: FIFO 0 holds three frames (RM0090 Rev 21 §32.7.3) and no frame is shorter than 47 µs at 1 Mbit/s,
    /// so if this starts more than 141 µs after the first frame, the fourth is lost. `otg_fs` (2) may wait: USB can
    /// NAK.
    #[task(binds = CAN1_RX1, priority = 4, shared = [tap, &can1_bells, &can1_entered])]
    fn can1_drain(mut cx: can1_drain::Context) {
        let entered = cx.shared.can1_entered.load(Ordering::Relaxed);
        let emptied = cx.shared.tap.lock(|Tap { capture, traffic, alarm, .. }| {
            capture.on_receive(Channel::Can1, traffic, alarm, entered)
        });
        if emptied {
            cx.shared.can1_bells.open_receive();
        }
    }

    /// Same as [`can1_drain`], for CAN2. DMA is not used, and the interrupt of its first stream raises this task: the vector of CAN2's own
    /// FIFO 1 is above those of the tasks that send, which would then go first.
    #[task(binds = DMA1_STREAM0, priority = 4, shared = [tap, &can2_bells, &can2_entered])]
    fn can2_drain(mut cx: can2_drain::Context) {
        let entered = cx.shared.can2_entered.load(Ordering::Relaxed);
        let emptied = cx.shared.tap.lock(|Tap { capture, traffic, alarm, .. }| {
            capture.on_receive(Channel::Can2, traffic, alarm, entered)
        });
        if emptied {
            cx.shared.can2_bells.open_receive();
        }
    }

    /// Stamps the end of a transmission on CAN1, and leaves the mailbox to [`can1_sent`].
    ///
    /// Priority 5, as [`can1_rx0`] and for the same reason: a confirmation's stamp must be as good as a frame's.
    #[task(binds = CAN1_TX, priority = 5, shared = [&stamp, &can1_bells, &can1_sent_at])]
    fn can1_tx(cx: can1_tx::Context) {
        cx.shared.can1_sent_at.store(cx.shared.stamp.now(), Ordering::Relaxed);
        cx.shared.can1_bells.silence_transmit();
        rtic::pend(Interrupt::USART2);
    }

    /// Same as [`can1_tx`], for CAN2.
    #[task(binds = CAN2_TX, priority = 5, shared = [&stamp, &can2_bells, &can2_sent_at])]
    fn can2_tx(cx: can2_tx::Context) {
        cx.shared.can2_sent_at.store(cx.shared.stamp.now(), Ordering::Relaxed);
        cx.shared.can2_bells.silence_transmit();
        rtic::pend(Interrupt::USART3);
    }

    /// Fills CAN1's mailboxes again and confirms what was sent. USART2 is not used, and its interrupt raises this task.
    ///
    /// Priority 4, because it writes records. Transmission stays back to back if this starts before the other two mailboxes are empty: 94
    /// µs at 1 Mbit/s. If it starts later, there is a pause on the bus. A further transmission that ends before this has emptied the
    /// mailboxes is stamped when it is found.
    #[task(binds = USART2, priority = 4, shared = [tap])]
    fn can1_sent(mut cx: can1_sent::Context) {
        cx.shared.tap.lock(|Tap { capture, traffic, alarm, .. }| {
            let entered = traffic[0].stamped();
            capture.on_transmit(Channel::Can1, traffic, alarm, entered);
        });
    }

    /// Same as [`can1_sent`], for CAN2, with USART3.
    #[task(binds = USART3, priority = 4, shared = [tap])]
    fn can2_sent(mut cx: can2_sent::Context) {
        cx.shared.tap.lock(|Tap { capture, traffic, alarm, .. }| {
            let entered = traffic[1].stamped();
            capture.on_transmit(Channel::Can2, traffic, alarm, entered);
        });
    }

    /// Records CAN1's errors and changes of state.
    ///
    /// Priority 4, because it writes records. The controller keeps one error: a second, which comes at least 14 bit
    /// times later, replaces it uncounted if this has not started.
    #[task(binds = CAN1_SCE, priority = 4, shared = [tap, &stamp, &can1_bells])]
    fn can1_sce(mut cx: can1_sce::Context) {
        let entered = cx.shared.stamp.now();
        let may_come = cx
            .shared
            .tap
            .lock(|Tap { capture, traffic: [can1, _], .. }| capture.on_error(Channel::Can1, can1, entered));
        if !may_come {
            cx.shared.can1_bells.silence_errors();
        }
    }

    /// Same as [`can1_sce`], for CAN2.
    #[task(binds = CAN2_SCE, priority = 4, shared = [tap, &stamp, &can2_bells])]
    fn can2_sce(mut cx: can2_sce::Context) {
        let entered = cx.shared.stamp.now();
        let may_come = cx
            .shared
            .tap
            .lock(|Tap { capture, traffic: [_, can2], .. }| capture.on_error(Channel::Can2, can2, entered));
        if !may_come {
            cx.shared.can2_bells.silence_errors();
        }
    }

    /// Sends what is due.
    ///
    /// Priority 4, because it writes mailboxes and records. Each microsecond of delay makes a frame a microsecond late.
    #[task(binds = TIM2, priority = 4, shared = [tap])]
    fn tim2(mut cx: tim2::Context) {
        #[cfg(feature = "disturb")]
        cx.shared.tap.lock(crate::hw::access::Tap::on_pulse_alarm);
        cx.shared.tap.lock(|Tap { capture, traffic, alarm, .. }| {
            alarm.acknowledge();
            capture.on_alarm(traffic, alarm);
        });
    }

    /// Notes the edges of the receive pin being measured: CAN1's or CAN2's, depending on the board. Its interrupt is never
    /// enabled while its controller is on the bus.
    ///
    /// Priority 3: above USB, which can wait for the 6 ms that this lasts at most, and below everything that captures or sends. At 1
    /// Mbit/s an edge is followed by the next after a microsecond: edges noted too late are marked, and their frame is lost to the
    /// measurement.
    #[task(binds = EXTI15_10, priority = 3, shared = [&catcher])]
    fn exti15_10(cx: exti15_10::Context) {
        cx.shared.catcher.catch();
    }

    /// Same as [`exti15_10`], for a pin of the lines 5 to 9.
    #[task(binds = EXTI9_5, priority = 3, shared = [&catcher])]
    fn exti9_5(cx: exti9_5::Context) {
        cx.shared.catcher.catch();
    }

    /// Same as [`exti15_10`], for a pin of line 0.
    #[task(binds = EXTI0, priority = 3, shared = [&catcher])]
    fn exti0(cx: exti0::Context) {
        cx.shared.catcher.catch();
    }

    /// Talks to the host.
    ///
    /// Priority 2: the host waits as long as necessary (USB NAK), except that a bus reset wants an answer within 10 ms
    /// (USB 2.0 §7.1.7.5) and a control request within 50 ms (§9.2.6.4), or the enumeration fails.
    #[task(binds = OTG_FS, priority = 2, shared = [tap, session, usb, controls])]
    fn otg_fs(cx: otg_fs::Context) {
        let otg_fs::SharedResources { tap, session, usb, controls, .. } = cx.shared;
        usb.poll();
        session.poll(usb, &mut Access { tap, controls });
        // The last store may have been to USB (Cortex-M4 erratum 838869, see `Bells::open_receive`).
        cortex_m::asm::dsb();
    }

    /// Once a millisecond: flushes batches, keeps time, handles what no interrupt reports, feeds the watchdog.
    ///
    /// Priority 2, with USB, because it talks to the host too. A tick some milliseconds late delays a batch; one four
    /// seconds late restarts the chip.
    #[task(
        binds = TIM7,
        priority = 2,
        local = [tick, watchdog, watch: Watch = Watch::new()],
        shared = [tap, session, usb, controls, &can1_bells, &can2_bells],
    )]
    fn tim7(cx: tim7::Context) {
        let tim7::SharedResources { mut tap, session, usb, controls, can1_bells, can2_bells, .. } = cx.shared;
        cx.local.tick.acknowledge();
        cx.local.watchdog.feed();
        // Short locks, so that the transmission alarm can come between them: it fires 14 µs early, and a lock, a drain and its
        // own work have to fit into that.
        for channel in Channel::ALL {
            let emptied = tap
                .lock(|Tap { capture, traffic, alarm, .. }| capture.on_tick_receive(channel, traffic, alarm));
            match channel {
                _ if !emptied => {}
                Channel::Can1 => can1_bells.open_receive(),
                Channel::Can2 => can2_bells.open_receive(),
            }
            let (is_open, may_come) = tap.lock(|Tap { capture, traffic, alarm, .. }| {
                let is_open = capture.on_tick_errors(channel, &mut traffic[channel.index()], alarm);
                (is_open, capture.take_errors_held(channel))
            });
            match channel {
                _ if !may_come => {}
                Channel::Can1 => can1_bells.open_errors(),
                Channel::Can2 => can2_bells.open_errors(),
            }
            if !is_open {
                continue;
            }
            for _ in 0..CALLS_PER_TICK {
                let more = tap.lock(|Tap { capture, traffic, alarm, .. }| {
                    capture.on_tick_queues(channel, &mut traffic[channel.index()], alarm)
                });
                if !more {
                    break;
                }
            }
            tap.lock(|Tap { capture, alarm, .. }| capture.on_tick_losses(channel, alarm));
        }
        usb.tick();
        let (activity, channels) =
            tap.lock(|Tap { capture, .. }| (capture.take_activity(), capture.oddities()));
        controls.chip.tick(activity);
        let oddities = Oddities { channels, usb: usb.oddities() };
        if cx.local.watch.is_due(oddities, controls.stamp.now()) {
            controls.chip.record(&oddities);
        }
        let mut access = Access { tap, controls };
        session.tick(&mut access);
        session.poll(usb, &mut access);
        // As in `otg_fs`.
        cortex_m::asm::dsb();
    }

    /// Sleeps until the next interrupt.
    #[idle]
    fn idle(_: idle::Context) -> ! {
        loop {
            cortex_m::asm::wfi();
            // With a debugger attached, the clock keeps running in sleep; see `hw::start`.
            cortex_m::asm::isb();
        }
    }
}
