// SPDX-License-Identifier: Apache-2.0
#include "fuzz.h"
#include "stereo/session/frame_pairing.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  Bytes in(bytes);
  PairingOptions options;
  options.min_baseline = 0.01 * in.take<std::uint8_t>();
  options.max_baseline = 0.02 * in.take<std::uint8_t>();
  options.positions = in.take<std::int8_t>();
  options.history = in.take<std::uint8_t>() % 16;
  options.max_waiting = in.take<std::uint8_t>() % 20;
  options.settle_time = 0.01 * (in.take<std::uint8_t>() % 8);
  takes([&] {
    FramePairing pairing(options);
    std::int64_t now = in.take<std::uint32_t>();
    while (!in.empty()) {
      const auto operation = in.take<std::uint8_t>();
      now += in.take<std::int32_t>();
      if (operation % 16 == 0) {
        pairing.reset("asked");
      } else if (operation % 2 == 0) {
        PairingFrame frame;
        // Any stamp that a message can carry.
        frame.stamp_ns =
            operation % 8 == 2 ? std::int64_t{in.take<std::uint32_t>()} * 1000000000 : now;
        frame.frame_id = std::string(1, static_cast<char>('a' + operation / 128));
        frame.image = std::make_shared<int>(0);
        pairing.add(std::move(frame), now);
      } else {
        const auto set = pairing.poll(
            [&](const std::string&, std::int64_t) {
              PoseAnswer answer;
              answer.state = static_cast<PoseAnswer::State>(in.take<std::uint8_t>() % 3);
              answer.T_fixed_camera.translation().x() = 0.01 * in.take<std::int8_t>();
              return answer;
            },
            now);
        if (set) {
          require(!set->displaced.empty(), "a set has a displaced frame");
          require(set->displaced.size() <= static_cast<std::size_t>(options.positions),
                  "a set has no more displaced frames than asked for");
          for (const auto& displaced : set->displaced) {
            const double baseline = displaced.T_ref_disp.translation().norm();
            require(baseline >= options.min_baseline * (1 - 1e-9) &&
                        baseline <= options.max_baseline * (1 + 1e-9),
                    "baselines keep their limits");
          }
        }
      }
      require(pairing.held() <= options.max_waiting + options.history + 1,
              "frames held are bounded");
    }
  });
}
