//! What values mean, by the constants of their definition: `HEALTH_OK = 0` for a field `health`.

use rustc_hash::{FxHashMap, FxHashSet};

use super::model::{Kind, Member};

/// Gives the constants to the fields whose values they are: by the beginning of their names, or all to the only field.
pub fn assign(members: &mut [Member], constants: &[(String, i64)]) {
    let can_have = |member: &Member| matches!(scalar(&member.kind), Kind::Unsigned(_) | Kind::Signed(_));
    let numbers = || members.iter().enumerate().filter(|(_, member)| can_have(member));
    let is_only = members.iter().filter(|member| !member.name.is_empty()).count() == 1;
    let only = numbers().next().map(|(at, _)| at).filter(|_| is_only);
    let stems: FxHashMap<String, usize> = numbers()
        .flat_map(|(at, member)| stems(&member.name).into_iter().map(move |stem| (stem, at)))
        .collect();
    let mut known: FxHashSet<(usize, i64)> = FxHashSet::default();
    for (name, value) in constants {
        if is_limit(name) {
            continue;
        }
        // The longest beginning that is one of a field.
        let mut beginnings = name.rmatch_indices('_').map(|(at, _)| at + 1);
        let best = beginnings.find_map(|end| Some((end, *stems.get(&name[..end])?)));
        let Some((skipped, at)) = best.or_else(|| Some((0, only?))) else { continue };
        if known.insert((at, *value)) {
            members[at].meanings.push((*value, name[skipped..].to_lowercase()));
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
