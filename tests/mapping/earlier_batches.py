"""Batches in base 85, and the BLAKE2b digests (16 bytes) of the fields decoded from them: of version 1 as
gmmtorch wrote and read them before version 2 of batches, and one each of versions 2 and 4."""

EARLIER = {
    "flat": (
        "0R$KhAwU2C002S0ZFUgShk#H4y9_K{hb~|gyi82c1dax4sUR%K4Zsqw5Dagn2n?4D{DDi9K6+T%h>Riq5y(<)Pj~%Z"
        "2-rR}rg?P?2!^QATSXxESpfhDL;xkHr9i+j2E~fX2qY_YmLq^UsB#Vm#bW{z%~!;n@5^n+BRPc|TWR)UfR}dj%D}mS"
        "ja&",
        "eb4c8e2b3dd4a06f6f2760a2f120e4b8",
    ),
    "space": (
        "0R|WjWD8Sj5C8xG072R$wsZ%@v>+iAD|<^N@CX3`D%r{8iX*Nxi#W)a!6AsHYv=)3zLW%+$l795y~70$*$1Nn-UN#R"
        "$^^Xv^aPl!&a4_~PD>re#}iZsNP%6fL)wBc>><(sCuvr2F+M~`qJ}*D%``6SS?AK1^ICq3$FMLGHc*wZ=vWMfa0mkc"
        "0Rck5(*b~4Bw#FZ5L;6#OXCmiFdf8TT$Uaq7k)Bjp7m_$iI7+cLNCl7s@O*|F#LkY$<dNwD@p|jr>oD}rO#^VT}Ck",
        "88ab603191edeb2273f0804936dda1e4",
    ),
    "far": (
        "0R{>Vq(T4y000O#fe@%*2f720f-ti@fqtZdxn0oLek<YT@P8=Sv<RS1NZ7OufIVo~v<iSpd}+F%c`W;wT|g|{j8#Z>"
        "9pB(o0UCrMhRgsU0)Pg_1_4sQ3>;_p0OL^N?WHWBLI(0XU$?d3p$P6TG6Kp3AsN#GrzXExJ<3R|$U7(yg+#<6Vm@PE"
        "a<Fo_QX~",
        "aa27993964b37709c8f501116854d898",
    ),
    "empty": (
        "0R{j7000000000000000001BWAOIi$00000000000000000000005%-0W<",
        "cae66941d9efbd404e4d88758ea67670",
    ),
    "one": ("0R#dB0000000w{q0s+&2g1~?P00KY&004jh002N7OxXETL;3)m0JgD}1p", "a9d2bb542e9f8557cec1dccd0d1e63c5"),
    "version 2": (
        "0>CIRC;$ml+dt}c?$*A}CGUr4!O=aW1*e0jX<HJkz?OFxlkk5Q<fiI8uROXa8OwCi367@gujC>R`@_}mdzpTpuSOzY"
        "^E+-niy-WM9r@9r5rfzU=@||tpHa@<1IUHUXYn`0jvL{zbya_npE&+A&8RI!OuP",
        "0addb3f5c4392b357e04ea6ac417ebf7",
    ),
    "version 4": (
        "1js-L003H@U&oTT@<_dXhKR#iac+}q)Pj1Qw}$Km^NRUOKRyhfn!<<R>FOS?0&gGH@%5^k{@C=?yC@F(uF<P?T7l5)eb=!",
        "bba5c28e77a767b9c90e00f1991439ca",
    ),
}
