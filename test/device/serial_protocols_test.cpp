// SPDX-License-Identifier: Apache-2.0
#include <gtest/gtest.h>

#include "device/stage/grbl/grbl_protocol.h"
#include "device/stage/zaber/zaber_protocol.h"

namespace omnister::device {
namespace {

TEST(ZaberProtocol, ChecksumsAreThoseOfTheManufacturersExamples) {
  // From the tests of Zaber's own libraries for Python and MATLAB.
  EXPECT_EQ(zaberChecksum("01 0 OK IDLE -- 0"), "8D");
  EXPECT_EQ(zaberChecksum("01 0 OK IDLE -- 7z"), "0C");
  EXPECT_EQ(zaberChecksum("1 3 9 OK IDLE -- 0"), "61");
  EXPECT_EQ(zaberCommand(1, 1, 7, "move abs 36283"),
            "/1 1 07 move abs 36283:" + zaberChecksum("1 1 07 move abs 36283") + "\n");
  EXPECT_EQ(zaberCommand(2, 0, 99, ""), "/2 0 99:" + zaberChecksum("2 0 99") + "\n");
}

TEST(ZaberProtocol, RepliesAreReadWhole) {
  const auto reply = parseZaberReply("@01 0 OK IDLE -- 0:8D");
  ASSERT_TRUE(reply);
  EXPECT_EQ(reply->device, 1);
  EXPECT_EQ(reply->axis, 0);
  EXPECT_FALSE(reply->id);
  EXPECT_TRUE(reply->accepted && !reply->busy && reply->has_checksum);
  EXPECT_EQ(reply->warning, "--");
  EXPECT_EQ(reply->data, "0");
  const auto rejected = parseZaberReply("@02 1 41 RJ BUSY FS BADDATA");
  ASSERT_TRUE(rejected);
  EXPECT_EQ(rejected->id, 41);
  EXPECT_FALSE(rejected->accepted);
  EXPECT_TRUE(rejected->busy);
  EXPECT_FALSE(rejected->has_checksum);
  EXPECT_EQ(rejected->warning, "FS");
  EXPECT_EQ(rejected->data, "BADDATA");
  EXPECT_EQ(parseZaberReply("@01 1 07 OK IDLE WR 02 FS WR")->data, "02 FS WR");
}

TEST(ZaberProtocol, WhatIsNotExactlyAReplyIsRefused) {
  int refused = 0;
  for (const char* line :
       {"", "@", "@01", "@01 0 OK IDLE --", "@01 0 OK IDLE -- 0:8E", "@01 0 OK IDLE -- 0:8d",
        "@01 0 OK IDLE -- 1:8D", "@0l 0 OK IDLE -- 0", "@01 0 0K IDLE -- 0", "@01 0 OK IDEL -- 0",
        "@01 0 OK IDLE - 0", "@01  0 OK IDLE -- 0", "@01 0 123 OK IDLE -- 0", "#01 0 OK IDLE -- 0",
        "@01 0 OK IDLE -- 0:8", "@01 0 OK IDLE -- 0\x01", "ok", "<Idle|MPos:0.000,0.000,0.000>"}) {
    EXPECT_FALSE(parseZaberReply(line)) << line;
    ++refused;
  }
  EXPECT_EQ(refused, 18);
  // With a checksum no changed character passes.
  const std::string good =
      "@01 1 07 OK BUSY -- 123456:" + zaberChecksum("01 1 07 OK BUSY -- 123456");
  ASSERT_TRUE(parseZaberReply(good));
  for (std::size_t i = 0; i < good.size(); ++i) {
    for (char c = ' '; c < '\x7f'; ++c) {
      std::string bad = good;
      bad[i] = c;
      const auto reply = parseZaberReply(bad);
      EXPECT_TRUE(bad == good || !reply || !reply->has_checksum) << bad;
    }
  }
}

TEST(ZaberProtocol, AlertsAndInfosAreNotices) {
  EXPECT_TRUE(isZaberNotice("!01 1 IDLE --"));
  EXPECT_TRUE(isZaberNotice("#01 1 07 some text"));
  EXPECT_TRUE(isZaberNotice("!01 1 IDLE --:" + zaberChecksum("01 1 IDLE --")));
  EXPECT_FALSE(isZaberNotice("!01 1 IDLE --:00"));
  EXPECT_FALSE(isZaberNotice("@01 0 OK IDLE -- 0"));
  EXPECT_FALSE(isZaberNotice("!?"));
}

TEST(GrblProtocol, ReportsAreReadWhole) {
  const auto jog = parseGrblStatus("<Jog|MPos:1.000,-2.500,0.000|FS:500,0|Ov:100,100,100>");
  ASSERT_TRUE(jog);
  EXPECT_EQ(jog->state, "Jog");
  ASSERT_TRUE(jog->machine);
  EXPECT_EQ((*jog->machine)[0], 1.0);
  EXPECT_EQ((*jog->machine)[1], -2.5);
  EXPECT_FALSE(jog->work || jog->offset);
  const auto hold =
      parseGrblStatus("<Hold:1|WPos:0.0000,0.0000,0.0000|Pn:X|WCO:1.0000,0.0000,0.0000>");
  ASSERT_TRUE(hold);
  EXPECT_EQ(hold->sub_state, 1);
  EXPECT_TRUE(hold->work && hold->offset && !hold->machine);
}

TEST(GrblProtocol, WhatIsNotExactlyAReportIsRefused) {
  int refused = 0;
  for (const char* line :
       {"<>", "<Idle>", "<Idle|MPos:1.000,2.000>", "<Idle|MPos:1.000,2.000,3.0>",
        "<Idle|MPos:1.000,2.000,3.000", "Idle|MPos:1.000,2.000,3.000>",
        "<Idel|MPos:1.000,2.000,3.000>", "<Idle|MPos:1.0x0,2.000,3.000>",
        "<Idle|MPos:1.000,2.000,3.000,4.000>", "<Idle|MPos:1.000,2.000,3.000||FS:0,0>",
        "<Idle|MPos:1000,2.000,3.000>", "<Idle|MPos:1.000,2.000,3.000|WPos:1.000,2.000,3.000>",
        "<Hold:7|MPos:1.000,2.000,3.000>", "<Idle|MPos:1e3.000,2.000,3.000>", "ok"}) {
    EXPECT_FALSE(parseGrblStatus(line)) << line;
    ++refused;
  }
  EXPECT_EQ(refused, 15);
  EXPECT_EQ(parseGrblCode("ALARM:9", "ALARM:"), 9);
  EXPECT_EQ(parseGrblCode("error:15", "error:"), 15);
  EXPECT_FALSE(parseGrblCode("error:", "error:"));
  EXPECT_FALSE(parseGrblCode("error:1x", "error:"));
  EXPECT_EQ(grblAlarmName(1), "hard limit (ALARM:1)");
  EXPECT_EQ(grblErrorName(15), "outside the soft limits (error:15)");
}

}  // namespace
}  // namespace omnister::device
