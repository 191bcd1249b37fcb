//! Authentication: the content of its requests and responses, by sub-function. The
//! fields are those of the Python package py-uds, with which a test compares them.

use super::cursor::Cursor;

/// Bytes of the algorithm's object identifier.
const ALGORITHM: usize = 16;

/// The content of a request after the sub-function, which does not include the bit that suppresses the response.
pub fn request(sub: u8, cursor: &mut Cursor<'_, '_>) -> Option<()> {
    match sub {
        0x01 | 0x02 => {
            cursor.hex("communication_configuration", 1)?;
            cursor.sized("certificate_client")?;
            cursor.sized("challenge_client")
        }
        0x03 => {
            cursor.sized("proof_of_ownership_client")?;
            cursor.sized("ephemeral_public_key_client")
        }
        0x04 => {
            cursor.hex("certificate_evaluation", 2)?;
            cursor.sized("certificate_data")
        }
        0x05 => {
            cursor.hex("communication_configuration", 1)?;
            cursor.bytes("algorithm", ALGORITHM)
        }
        0x06 | 0x07 => {
            cursor.bytes("algorithm", ALGORITHM)?;
            cursor.sized("proof_of_ownership_client")?;
            cursor.sized("challenge_client")?;
            cursor.sized("additional_parameter")
        }
        _ => None,
    }
}

/// The content of a positive response after the sub-function.
pub fn response(sub: u8, cursor: &mut Cursor<'_, '_>) -> Option<()> {
    cursor.byte("result", result)?;
    match sub {
        0x01 => {
            cursor.sized("challenge_server")?;
            cursor.sized("ephemeral_public_key_server")
        }
        0x02 => {
            cursor.sized("challenge_server")?;
            cursor.sized("certificate_server")?;
            cursor.sized("proof_of_ownership_server")?;
            cursor.sized("ephemeral_public_key_server")
        }
        0x03 => cursor.sized("session_key_information"),
        0x05 => {
            cursor.bytes("algorithm", ALGORITHM)?;
            cursor.sized("challenge_server")?;
            cursor.sized("needed_additional_parameter")
        }
        0x06 => {
            cursor.bytes("algorithm", ALGORITHM)?;
            cursor.sized("session_key_information")
        }
        0x07 => {
            cursor.bytes("algorithm", ALGORITHM)?;
            cursor.sized("proof_of_ownership_server")?;
            cursor.sized("session_key_information")
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
