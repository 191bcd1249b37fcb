//! Authentication: the content of its requests and responses, by sub-function. The
//! fields are those of the Python package py-uds, with which a test compares them.

use super::reader::Reader;

/// Bytes of the algorithm's object identifier.
const ALGORITHM: usize = 16;

/// The content of a request after the sub-function, which does not include the bit that suppresses the response.
pub fn request(sub: u8, reader: &mut Reader<'_, '_>) -> Option<()> {
    match sub {
        0x01 | 0x02 => {
            reader.hex("communication_configuration", 1)?;
            reader.sized("certificate_client")?;
            reader.sized("challenge_client")
        }
        0x03 => {
            reader.sized("proof_of_ownership_client")?;
            reader.sized("ephemeral_public_key_client")
        }
        0x04 => {
            reader.hex("certificate_evaluation", 2)?;
            reader.sized("certificate_data")
        }
        0x05 => {
            reader.hex("communication_configuration", 1)?;
            reader.bytes("algorithm", ALGORITHM)
        }
        0x06 | 0x07 => {
            reader.bytes("algorithm", ALGORITHM)?;
            reader.sized("proof_of_ownership_client")?;
            reader.sized("challenge_client")?;
            reader.sized("additional_parameter")
        }
        _ => None,
    }
}

/// The content of a positive response after the sub-function.
pub fn response(sub: u8, reader: &mut Reader<'_, '_>) -> Option<()> {
    reader.byte("result", result)?;
    match sub {
        0x01 => {
            reader.sized("challenge_server")?;
            reader.sized("ephemeral_public_key_server")
        }
        0x02 => {
            reader.sized("challenge_server")?;
            reader.sized("certificate_server")?;
            reader.sized("proof_of_ownership_server")?;
            reader.sized("ephemeral_public_key_server")
        }
        0x03 => reader.sized("session_key_information"),
        0x05 => {
            reader.bytes("algorithm", ALGORITHM)?;
            reader.sized("challenge_server")?;
            reader.sized("needed_additional_parameter")
        }
        0x06 => {
            reader.bytes("algorithm", ALGORITHM)?;
            reader.sized("session_key_information")
        }
        0x07 => {
            reader.bytes("algorithm", ALGORITHM)?;
            reader.sized("proof_of_ownership_server")?;
            reader.sized("session_key_information")
        }
        _ => None,
    }
}

/// Values of the return parameter.
fn result(byte: u8) -> Option<&'static str> {
    Some(match byte {
        0x00 => "accepted",
        0x01 => "rejected",
        0x02 => "by exchange of certificates",
        0x03 => "by challenge and response, asymmetric",
        0x04 => "by challenge and response, symmetric",
        0x10 => "deauthenticated",
        0x11 => "certificate verified, ownership to be verified",
        0x12 => "ownership verified, authentication complete",
        0x13 => "certificate verified",
        _ => return None,
    })
}
