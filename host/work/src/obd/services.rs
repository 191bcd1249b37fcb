//! How OBD-II is asked: by its own services (SAE J1979), or over UDS (SAE J1979-2), which vehicles have in their place from model year 2027
//! on, and some earlier. What an answer means is the same.

/// Which services a vehicle has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Services {
    /// 01 to 0A.
    Own,
    /// 22 with identifiers F4xx and F8xx, 19 and 14 for the group of emissions (33).
    OnUds,
}

impl Services {
    /// The request for a parameter's value; every 32nd lists the next ones.
    pub fn value(self, pid: u8) -> Vec<u8> {
        match self {
            Self::Own => vec![0x01, pid],
            Self::OnUds => vec![0x22, 0xF4, pid],
        }
    }

    /// The bits of a list, if the answer is the one to [`Self::value`].
    pub fn bits(self, base: u8, answer: &[u8]) -> Option<&[u8]> {
        match (self, answer) {
            (Self::Own, [0x41, pid, bits @ ..]) | (Self::OnUds, [0x62, 0xF4, pid, bits @ ..]) => {
                (*pid == base && bits.len() >= 4).then_some(bits)
            }
            _ => None,
        }
    }

    /// The requests for each kind of trouble codes. Over UDS: by status, of any severity class that has to do with emissions.
    pub const fn codes(self) -> [(&'static str, &'static [u8]); 3] {
        match self {
            Self::Own => [("stored", &[0x03]), ("pending", &[0x07]), ("permanent", &[0x0A])],
            Self::OnUds => [
                ("confirmed", &[0x19, 0x42, 0x33, 0x08, 0x1E]),
                ("pending", &[0x19, 0x42, 0x33, 0x04, 0x1E]),
                ("permanent", &[0x19, 0x55, 0x33]),
            ],
        }
    }

    /// The request that erases trouble codes.
    pub const fn clear(self) -> &'static [u8] {
        match self {
            Self::Own => &[0x04],
            Self::OnUds => &[0x14, 0xFF, 0xFF, 0x33],
        }
    }

    /// The requests for the VIN, the ECU's name and its calibrations.
    pub fn identification(self) -> [Vec<u8>; 3] {
        [0x02, 0x0A, 0x04].map(|kind| match self {
            Self::Own => vec![0x09, kind],
            Self::OnUds => vec![0x22, 0xF8, kind],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_belongs_to_its_list_and_is_as_long_as_one() {
        let bits = |services: Services, answer: &[u8]| services.bits(0x20, answer).map(<[u8]>::to_vec);
        assert_eq!(bits(Services::Own, &[0x41, 0x20, 1, 2, 3, 4]), Some(vec![1, 2, 3, 4]));
        assert_eq!(bits(Services::OnUds, &[0x62, 0xF4, 0x20, 1, 2, 3, 4]), Some(vec![1, 2, 3, 4]));
        for answer in [&[0x41, 0x00, 1, 2, 3, 4][..], &[0x41, 0x20, 1, 2, 3], &[0x7F, 0x01, 0x12]] {
            assert_eq!(bits(Services::Own, answer), None);
        }
    }
}
