-- All places where a condition held, with a second before and after: every value and every loss in that time.
--
-- Put your own signals and condition in the two places that are marked. A signal keeps its value until the next one comes, or frames are
-- lost. Signals of one frame change together.
WITH numbered AS (
    SELECT *, count_if(event = 'lost') OVER (PARTITION BY trace ORDER BY row) AS losses
    FROM signals
),
instants AS (
    SELECT
        trace, losses, time_ns,
        -- The signals.
        max(CASE WHEN signal = 'VehicleSpeed' THEN value END) AS speed,
        max(CASE WHEN signal = 'BrakePressure' THEN value END) AS pressure
    FROM numbered
    GROUP BY trace, losses, time_ns
),
known AS (
    SELECT
        trace, losses, time_ns,
        last_value(speed, true) OVER latest AS speed,
        last_value(pressure, true) OVER latest AS pressure,
        lead(time_ns) OVER latest AS next_ns
    FROM instants
    WINDOW latest AS (PARTITION BY trace, losses ORDER BY time_ns)
),
judged AS (
    SELECT
        *,
        -- The condition.
        coalesce(speed > :speed AND pressure > :pressure, false) AS held
    FROM known
),
islands AS (
    SELECT *, count_if(NOT held) OVER (PARTITION BY trace, losses ORDER BY time_ns) AS island
    FROM judged
),
places AS (
    SELECT trace, min(time_ns) AS begin_ns, max(coalesce(next_ns, time_ns)) AS end_ns
    FROM islands
    WHERE held
    GROUP BY trace, losses, island
)
SELECT
    signals.vehicle, places.trace,
    timestamp_micros(places.begin_ns DIV 1000) AS began,
    (places.end_ns - places.begin_ns) / 1e9 AS seconds,
    signals.time, signals.channel, signals.event, signals.count,
    signals.message, signals.signal, signals.value, signals.text, signals.unit
FROM places
JOIN signals
    ON signals.trace = places.trace
    AND signals.time_ns BETWEEN places.begin_ns - 1000000000 AND places.end_ns + 1000000000
ORDER BY signals.vehicle, places.trace, places.begin_ns, signals.row
