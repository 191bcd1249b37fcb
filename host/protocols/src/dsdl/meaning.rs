//! What values mean, by the constants of their definition: `HEALTH_OK = 0` for a field `health`.

use super::model::{Kind, Member};

/// Gives the constants to the fields whose values they are: by the beginning of their names, or all to the only field.
pub fn assign(members: &mut [Member], constants: &[(String, i64)]) {
    let can_have = |member: &Member| matches!(scalar(&member.kind), Kind::Unsigned(_) | Kind::Signed(_));
    let named = members.iter().filter(|member| !member.name.is_empty()).count();
    for (name, value) in constants {
        if is_limit(name) {
            continue;
        }
        let beginnings = members.iter().enumerate().filter(|(_, member)| can_have(member));
        let best = beginnings.filter_map(|(at, member)| {
            let stem = stems(&member.name).into_iter().find(|stem| name.starts_with(&**stem))?;
            Some((stem.len(), at))
        });
        let (skipped, at) = match best.max_by_key(|(length, _)| *length) {
            Some(best) => best,
            None if named == 1 => match members.iter().position(can_have) {
                Some(at) => (0, at),
                None => continue,
            },
            None => continue,
        };
        let member = &mut members[at];
        if member.meanings.iter().all(|(known, _)| known != value) {
            member.meanings.push((*value, name[skipped..].to_lowercase()));
        }
    }
    for member in members {
        let is_bit = |value: i64| value > 0 && value.count_ones() == 1;
        member.is_flags = member.name.ends_with("flags")
            || member.name == "status" && member.meanings.len() > 2 && {
                member.meanings.iter().filter(|(value, _)| *value != 0).all(|(value, _)| is_bit(*value))
                    && member.meanings.iter().any(|(value, _)| *value > 2)
            };
    }
}

/// The beginnings that a field's constants may have.
fn stems(field: &str) -> Vec<String> {
    let upper = field.to_uppercase();
    let mut stems = vec![format!("{upper}_")];
    stems.extend(upper.strip_suffix('S').map(|one| format!("{one}_")));
    stems.extend(upper.strip_suffix("_PCT").map(|one| format!("{one}_")));
    stems
}

fn scalar(kind: &Kind) -> &Kind {
    match kind {
        Kind::Array(element, _) => element,
        kind => kind,
    }
}

/// Constants that are no values of fields.
fn is_limit(name: &str) -> bool {
    let parts: Vec<_> = name.split('_').collect();
    parts
        .iter()
        .any(|part| matches!(*part, "MAX" | "MIN" | "TIMEOUT" | "PERIOD" | "CAPACITY" | "LENGTH" | "MTU"))
}

/// The meaning of a value.
pub fn of(member: &Member, value: i64) -> Option<String> {
    let name = |wanted: i64| member.meanings.iter().find(|(known, _)| *known == wanted);
    if member.meanings.is_empty() {
        return None;
    }
    if !member.is_flags || value == 0 {
        return name(value).map(|(_, name)| name.clone());
    }
    let set = member.meanings.iter().filter(|(bits, _)| *bits != 0 && value & bits == *bits);
    let names: Vec<_> = set.map(|(_, name)| name.as_str()).collect();
    (!names.is_empty()).then(|| names.join(", "))
}
