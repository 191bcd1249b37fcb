//! Whole pictures.

use super::*;

/// Two analogue panes with alarms, a digital one, and a loss in the middle.
fn drive() -> Plot {
    let mut speed = Curve::new("Speed");
    speed.alarm_above = Some(110.0);
    let mut temperature = Curve::new("Temperature <oil>");
    temperature.alarm_below = Some(60.0);
    temperature.alarm_above = Some(120.0);
    let mut brake = Curve::new("Brake");
    brake.stepped = true;
    let mut gear = Curve::new("Gear");
    gear.stepped = true;
    for n in 0..600 {
        let t = f64::from(n) / 10.0;
        if (25.0..30.0).contains(&t) {
            if n == 250 {
                for curve in [&mut speed, &mut temperature, &mut brake, &mut gear] {
                    curve.series.interrupt();
                }
            }
            continue;
        }
        speed.series.push(t, 60.0 + 58.0 * (t / 8.0).sin());
        temperature.series.push(t, 50.0 + t * 0.8 + (t * 3.0).sin());
        brake.series.push(t, f64::from(u8::from((t / 8.0).cos() < -0.3)));
        gear.series.push(t, (3.0 + 2.0 * (t / 8.0).sin()).round());
    }
    let pane = |label: &str, content| Pane { label: label.to_owned(), range: None, content };
    Plot {
        title: "drive.log: speed, temperature & brake".to_owned(),
        axis: Axis::Time { zero: "2014-09-14 15:58:34 UTC".to_owned() },
        panes: vec![
            pane("km/h", Content::Analogue(vec![speed])),
            pane("°C", Content::Analogue(vec![temperature])),
            pane("", Content::Analogue(vec![gear])),
            pane("", Content::Digital(vec![brake])),
        ],
        gaps: vec![Gap { from: 24.9, to: 30.0, frames: 1234 }],
    }
}

fn histogram() -> Plot {
    let mut periods = Histogram::default();
    for n in 0..5000i64 {
        let noise: i64 = (0..6).map(|k| n.wrapping_mul(7919 + k * 104_729).rem_euclid(100_000)).sum();
        periods.add(10_000_000 + noise - 300_000);
    }
    let (bars, _) = periods.bars(60);
    Plot {
        title: "123 on channel 1: periods".to_owned(),
        axis: Axis::Value { label: "period in ms".to_owned() },
        panes: vec![Pane { label: "count".to_owned(), range: None, content: Content::Bars(bars) }],
        gaps: Vec::new(),
    }
}

/// Everything in the plot is in the document, and the content of a name cannot break it.
#[test]
fn an_svg_names_its_curves_and_escapes_them() {
    let svg = String::from_utf8(drive().render(PictureFormat::Svg, 1000).unwrap()).unwrap();
    for part in
        ["km/h", "Temperature &lt;oil&gt;", "temperature &amp; brake", "1234 frames lost here", "15:58:34"]
    {
        assert!(svg.contains(part), "{part}");
    }
    assert!(!svg.contains("NaN") && !svg.contains("inf"));
    // The loss interrupts every curve: two lines each, and one in the legend.
    assert_eq!(svg.matches(r#"<polyline data-curve="0""#).count(), 3);
}

/// They were drawn as if they had the range's last value.
#[test]
fn values_beyond_the_range_are_cut_off() {
    let mut curve = Curve::new("Speed");
    for (t, y) in
        [(0.0, 0.0), (1.0, 4.0), (2.0, 40.0), (3.0, 40.0), (4.0, 4.0), (5.0, -90.0), (6.0, -90.0), (7.0, 2.0)]
    {
        curve.series.push(t, y);
    }
    for stepped in [false, true] {
        let curve = Curve { stepped, ..curve.clone() };
        let pane =
            Pane { label: String::new(), range: Some((0.0, 5.0)), content: Content::Analogue(vec![curve]) };
        let plot = Plot { panes: vec![pane], ..Plot::default() };
        let svg = String::from_utf8(plot.render(PictureFormat::Svg, 1000).unwrap()).unwrap();
        let lines: Vec<Vec<(f32, f32)>> = svg
            .split(r#"<polyline data-curve="0" points=""#)
            .skip(1)
            .map(|rest| {
                let points = rest.split('"').next().unwrap().split(' ');
                let number = |text: &str| text.parse().unwrap();
                points
                    .map(|point| point.split_once(',').map(|(x, y)| (number(x), number(y))).unwrap())
                    .collect()
            })
            .collect();
        // The legend's, and three stretches inside.
        assert_eq!(lines.len(), 4, "{stepped}: {lines:?}");
        let (low, high) = lines[1..]
            .iter()
            .flatten()
            .fold((f32::MAX, f32::MIN), |(low, high), (_, y)| (low.min(*y), high.max(*y)));
        assert!((high - low - 200.0).abs() < 0.2, "{low} {high}");
        for pair in lines[1..].iter().flat_map(|line| line.windows(2)) {
            let is_along = |edge: f32| (pair[0].1 - edge).abs() < 0.1 && (pair[1].1 - edge).abs() < 0.1;
            assert!(
                !is_along(low) && (stepped || !is_along(high))
                    || (pair[0].0 - pair[1].0).abs() < f32::EPSILON,
                "{stepped}: {pair:?}"
            );
        }
        let text = plot.to_text(&TextStyle::default());
        let rows: Vec<_> = text.lines().filter(|line| line.contains(['│', '┤'])).collect();
        let dots =
            |row: &str| row.chars().filter(|symbol| ('\u{2801}'..='\u{28FF}').contains(symbol)).count();
        assert!(dots(rows[0]) < 12 && dots(rows[rows.len() - 1]) < 24, "{text}");
    }
}

/// The whole of them shows under the pointer.
#[test]
fn long_captions_and_texts_of_values_fit_and_are_whole_under_the_pointer() {
    let long = "A caption that is far too long for the picture in which it is ".repeat(4);
    let mut curve = Curve::new(long.trim());
    curve.texts = vec![(0.0, "a text for zero that nobody can read".into()), (1.0, "on".into())];
    (0..4).for_each(|n| curve.series.push(f64::from(n), f64::from(n % 2)));
    let pane = Pane { label: String::new(), range: None, content: Content::Analogue(vec![curve]) };
    let axis = Axis::Time { zero: long.trim().to_owned() };
    let plot = Plot {
        title: long.trim().to_owned(),
        axis,
        panes: vec![pane],
        gaps: vec![Gap { from: 1.0, to: 2.0, frames: 9 }],
    };
    let svg = String::from_utf8(plot.render(PictureFormat::Svg, 600).unwrap()).unwrap();
    for text in svg.split("<text").skip(1).map(|text| text.split("</text>").next().unwrap()) {
        let shown = text.rsplit(['>']).next().unwrap();
        assert!(shown.chars().count() <= 62, "{shown}");
    }
    assert_eq!(svg.matches(&format!("<title>{}</title>", long.trim())).count(), 2, "title and legend");
    assert!(svg.contains("<title>a text for zero that nobody can read</title>"));
}

#[test]
fn a_png_has_the_size_asked_for() {
    let png = drive().render(PictureFormat::Png, 800).unwrap();
    assert_eq!(png[..8], *b"\x89PNG\r\n\x1a\n");
    assert_eq!(u32::from_be_bytes([png[16], png[17], png[18], png[19]]), 1200);
}

#[test]
fn a_page_cannot_be_broken_out_of() {
    let mut plot = drive();
    plot.title = "</title><script>alert(1)</script>".to_owned();
    if let Content::Analogue(curves) = &mut plot.panes[0].content {
        curves[0].name = "</script>\"\\".to_owned();
    }
    let html = String::from_utf8(plot.render(PictureFormat::Html, 800).unwrap()).unwrap();
    assert_eq!(html.matches("<script>").count(), 1);
    assert_eq!(html.matches("</script>").count(), 1);
}

#[test]
fn nothing_to_show_is_still_a_picture() {
    let plot = Plot::default();
    for format in [PictureFormat::Svg, PictureFormat::Png, PictureFormat::Html] {
        assert!(!plot.render(format, 800).unwrap().is_empty());
    }
    assert_eq!(plot.to_text(&TextStyle::default()), "There is nothing to show.\n");
}

#[test]
fn a_terminal_shows_a_ramp_rising_from_corner_to_corner() {
    let mut ramp = Curve::new("Ramp");
    (0..=100).for_each(|n| ramp.series.push(f64::from(n), f64::from(n)));
    let mut on = Curve::new("On");
    on.stepped = true;
    for (x, y) in [(0.0, 0.0), (50.0, 1.0), (100.0, 1.0)] {
        on.series.push(x, y);
    }
    let plot = Plot {
        title: "Ramp".to_owned(),
        panes: vec![
            Pane { label: "V".to_owned(), range: Some((0.0, 100.0)), content: Content::Analogue(vec![ramp]) },
            Pane { label: String::new(), range: None, content: Content::Digital(vec![on]) },
        ],
        ..Plot::default()
    };
    let style = TextStyle { width: 40, pane_height: 5, colour: false, unicode: false };
    let expected = [
        "Ramp",
        "        V -- Ramp",
        "      100+                        ******",
        "         |                  *******",
        "         |            ******",
        "         |     *******",
        "        0+******",
        "          -- On",
        "       On|______________#---------------",
        "         ++----------------+------------",
        "          0               60",
        "                    time in s",
    ];
    assert_eq!(plot.to_text(&style).lines().collect::<Vec<_>>(), expected);
    assert!(plot.to_text(&TextStyle { unicode: true, ..style }).contains("       On│▁▁▁"));
}

/// Texts are shown at their values, and whole numbers have nothing between them.
#[test]
fn axes_name_states_and_whole_numbers() {
    let mut gear = Curve::new("Gear");
    gear.stepped = true;
    gear.whole = true;
    gear.texts = vec![(0.0, "Park".to_owned()), (1.0, "Reverse <R>".to_owned())];
    let mut count = Curve::new("Count");
    count.whole = true;
    let mut on = Curve::new("On");
    on.texts = vec![(0.0, "closed".to_owned()), (1.0, "open".to_owned())];
    for curve in [&mut gear, &mut count, &mut on] {
        for (x, y) in [(0.0, 0.0), (1.0, 1.0), (2.0, 0.0)] {
            curve.series.push(x, y);
        }
    }
    let pane = |label: &str, content| Pane { label: label.to_owned(), range: None, content };
    let plot = Plot {
        panes: vec![
            pane("", Content::Analogue(vec![gear])),
            pane("a long unit, to be read", Content::Analogue(vec![count])),
            pane("", Content::Digital(vec![on])),
        ],
        ..Plot::default()
    };
    let svg = String::from_utf8(plot.render(PictureFormat::Svg, 800).unwrap()).unwrap();
    for part in [">Park<", ">Reverse…<", ">open<", ">closed<", ">a long unit, to be read<"] {
        assert!(svg.contains(part), "{part}: {svg}");
    }
    // The time axis has halves.
    assert!(!svg.contains("text-anchor=\"end\" fill=\"#666666\">0.5<"), "{svg}");
    let html = String::from_utf8(plot.render(PictureFormat::Html, 800).unwrap()).unwrap();
    assert!(html.contains("\"texts\":[[0,\"Park\"],[1,\"Reverse \\u003cR\\u003e\"]]"), "{html}");
    let text = plot.to_text(&TextStyle { unicode: false, ..TextStyle::default() });
    assert!(text.contains("Park+") && text.contains("a long unit, to be read -- Count"), "{text}");
}

#[test]
fn periods_are_drawn_from_zero() {
    let span = histogram().span();
    assert!(span.0 == 0.0 && span.1 > 10.0, "{span:?}");
}

#[test]
fn colour_is_used_only_where_asked_for() {
    let plot = drive();
    assert!(!plot.to_text(&TextStyle::default()).contains('\x1b'));
    assert!(
        plot.to_text(&TextStyle { colour: true, ..TextStyle::default() }).contains("\x1b[38;2;0;114;178m")
    );
}

#[test]
fn the_suffix_chooses_the_format() {
    assert_eq!(PictureFormat::of_path(Path::new("a/b.PNG")).unwrap(), PictureFormat::Png);
    let message = PictureFormat::of_path(Path::new("b.gif")).unwrap_err().to_string();
    assert_eq!(message, "'b.gif' names no picture format; use .svg, .png or .html");
}

/// Writes the pictures to a folder for inspection: `CANTAP_PICTURES=DIR cargo test -p cantap-analysis
/// --all-features pictures`.
#[test]
fn pictures_to_look_at_can_be_written() {
    let folder = std::env::var_os("CANTAP_PICTURES").map_or_else(std::env::temp_dir, Into::into);
    let folder = folder.join(format!("cantap-pictures-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    for (name, plot) in [("drive", drive()), ("histogram", histogram())] {
        for suffix in ["svg", "png", "html"] {
            plot.save(&folder.join(format!("{name}.{suffix}")), DEFAULT_WIDTH).unwrap();
        }
        std::fs::write(folder.join(format!("{name}.txt")), plot.to_text(&TextStyle::default())).unwrap();
    }
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 8);
    if std::env::var_os("CANTAP_PICTURES").is_none() {
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
