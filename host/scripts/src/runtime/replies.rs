//! What a device replies by itself, in place of a function of the script.

use std::collections::BTreeMap;

use cantap::wire::message::Filter;
use cantap_can::{Channel, Frame};
use rhai::FnPtr;

use super::Runtime;
use crate::exchange::Output;
use crate::handlers::{Handlers, Selector};
use crate::script_result::Result;

impl Runtime {
    /// What of the script is nothing but a constant reply, by the names of its functions.
    pub fn set_constant_replies(&self, replies: BTreeMap<String, (Channel, Frame)>) {
        *self.constant_replies.borrow_mut() = replies;
    }

    /// Calls a function with each selected frame; or the device does by itself what the function does, if it can and may. Returns its handle.
    pub fn on_frame(&self, selector: Selector, call: FnPtr) -> Result<u32> {
        let Some((slots, filters, frame)) = self.device_reply(&selector, &call) else {
            return self.react(|handlers| handlers.on_frame(selector, call));
        };
        let handle = self.with_handlers(Handlers::new_handle);
        for (slot, filter) in slots.iter().zip(filters) {
            self.set_reply(*slot, Some((filter, frame)))?;
        }
        self.state.borrow_mut().replies.insert(handle, slots);
        Ok(handle)
    }

    /// Free replies of the device for a function, and what they are.
    fn device_reply(&self, selector: &Selector, call: &FnPtr) -> Option<(Vec<u8>, Vec<Filter>, Frame)> {
        let replies = self.surroundings.replies?;
        let (_, frame) = *self
            .constant_replies
            .borrow()
            .get(call.fn_name())
            .filter(|(channel, _)| *channel == replies.channel)?;
        let filters = replies.filters(selector)?;
        let state = self.state.borrow();
        let is_free = |slot: &u8| !state.replies.values().flatten().any(|taken| taken == slot);
        // From the last one down: whoever shares the device takes them from the first one up.
        let slots: Vec<u8> = (0..replies.slots).rev().filter(is_free).take(filters.len()).collect();
        (slots.len() == filters.len()).then_some((slots, filters, frame))
    }

    fn set_reply(&self, slot: u8, entry: Option<(Filter, Frame)>) -> Result<()> {
        let Some(replies) = self.surroundings.replies else { return Ok(()) };
        self.output(Output::Reply { channel: replies.channel, slot, entry })
    }

    /// Ends what a script reacts to.
    pub fn end_reaction(&self, handle: u32) -> Result<()> {
        self.with_handlers(|handlers| handlers.end(handle));
        let slots = self.state.borrow_mut().replies.remove(&handle).unwrap_or_default();
        slots.into_iter().try_for_each(|slot| self.set_reply(slot, None))
    }
}
